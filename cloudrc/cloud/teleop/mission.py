"""The mission: operator's verbs and the robot as seen come in; setpoints and requests go out.

A pure state machine (`State`), joined to controller and robot by messages only:

    teleop.see(seen, now_ns)            with every telemetry that becomes the newest
    teleop.operate(verb, now_ns)        when the operator says something
    teleop.handle_deadline(now_ns)      regularly, at 10 Hz or faster
    teleop.take_outputs()               after any of them: Setpoint, OperatorRequest, MissionEvent

A `Setpoint` holds until the next, for one session; an `OperatorRequest` comes out at 10 Hz until
the robot is seen to have acted on it; each `MissionEvent` comes out once.

              StartMission             start seen             every waypoint reached
        IDLE -------------> STARTING -------------> FLYING --------------------------> DONE
    (or any end)                                Hold | ^ Resume
                                                     v |
                                                     HELD

Cancel leads from STARTING, FLYING and HELD to CANCELLED; a limit of time, a world that restarts,
a guard that lands or an emergency stop lead to FAILED. Every end holds: the robot is asked to hold
by itself, and the setpoint stays where it was seen. The robot keeps in mind how many waypoints are
reached and that a mission is over, for a teleop that forgets. Times are the caller's clock [ns].
"""

from __future__ import annotations

from collections.abc import Callable

from cloudrc.cloud.teleop import mission_rules as rules
from cloudrc.cloud.teleop.messages import (
    Acknowledge,
    Cancel,
    Continue,
    EmergencyStop,
    GoTo,
    Hold,
    Outcome,
    Output,
    Pause,
    Resume,
    Seen,
    StartMission,
    State,
    Verb,
)
from cloudrc.cloud.teleop.mission_aim import Aim
from cloudrc.cloud.teleop.mission_leg import LegWatch, overdue, where
from cloudrc.cloud.teleop.plan import NO_PLAN, Leg, Plan
from cloudrc.cloud.teleop.request import Repeater
from cloudrc.messages import MISSION_OVER, GuardState, Request, Start
from cloudrc.records import MissionEvent

# An enum's member is slow to look up; these are asked for in every period.
FLYING, STARTING = State.FLYING, State.STARTING
UNDER_WAY = rules.UNDER_WAY


class Teleop:
    """Flies missions, one after the other.

    Attributes:
        state: Of the mission.
        leg: Index of the waypoint that is flown to; the number of waypoints once all are reached.
        outcome: How it ended; None while there is none or it is under way.
        requests: What is asked of the robot.
        outputs: What it has said since the last `take_outputs`.
    """

    def __init__(self, ended: Callable[[int], bool] = lambda mission_id: False) -> None:
        """Begin at rest; `ended` says of a mission's number whether it is known to be over."""
        self.state = State.IDLE
        self.outcome: Outcome | None = None
        self.requests = Repeater()
        self.outputs: list[Output] = []
        self.leg = 0
        self._is_ended = ended
        self._seen: Seen | None = None
        self._plan = NO_PLAN
        self._mission_id = 0
        self._again = False
        self._continued: Continue | None = None  # how it stood, if a teleop before began it
        self._world = rules.ANY_WORLD  # in which it was started
        self._expected: tuple[int, ...] = ()  # missions that may be on board; any if there are none
        self._began_ns = 0
        self._watch = LegWatch()
        # Not the list's own method: every `take_outputs` leaves another list.
        self._aim = Aim(self.requests, lambda setpoint: self.outputs.append(setpoint))

    @property
    def settled(self) -> bool:
        """Whether the robot is seen to have acted on the last request."""
        return self.requests.settled

    def elapsed(self, now_ns: int) -> float:
        """Time since the mission began [s]."""
        return (now_ns - self._began_ns) * 1e-9

    def take_outputs(self) -> list[Output]:
        """Hand over what teleop has said since the last call, oldest first."""
        outputs, self.outputs = self.outputs, []
        return outputs

    def operate(self, verb: Verb, now_ns: int) -> None:
        """Do what the operator says.

        GoTo is a mission of one waypoint that starts from here; while a mission is held it moves
        only the point where it is held, and Resume goes on with the leg as before.

        Raises:
            BadInputError: If the state does not allow it or a value cannot be used; nothing has
                changed then.
        """
        rules.refuse_unless_fitting(verb, self.state)
        match verb:
            case StartMission(plan, mission_id, again):
                self._start(plan, mission_id, now_ns, again=again)
            case Continue():
                self._go_on(verb, now_ns)
            case Hold():
                self._hold(now_ns)
            case Resume():
                self._resume(now_ns)
            case Cancel():
                self._end("cancelled", "mission cancelled", now_ns)
            case GoTo(position, yaw, mission_id):
                self._go_to(Leg(position, yaw), mission_id, now_ns)
            case EmergencyStop():
                if self.state in UNDER_WAY:
                    self._end("emergency_stopped", f"emergency stop {self._where()}", now_ns)
                self.requests.ask(Request.ESTOP)
            case Acknowledge():
                self.requests.ask(Request.ACKNOWLEDGE, after=True)
            case Pause():
                self._tell("paused", self.leg, f"paused by shutdown {self._where()}", now_ns)
                self.requests.ask(Request.END)
                self._aim.stay()  # should the end be lost, cloud keeps this

    def see(self, seen: Seen, now_ns: int) -> None:
        """Take note of the newest telemetry, at the instant [ns] at which it arrives."""
        before, self._seen = self._seen, seen
        anew = self._aim.see(seen)
        told = self._aim.setpoint
        onboard, legs = rules.known_on_board(seen, self._mission_id), self._plan.legs
        started = self.requests.see(seen, now_ns) is Request.START and self.state is STARTING
        if self.state is STARTING and not self._expected and self._plan.start is Start.HERE:
            self._expected = (seen.mission_id, self._mission_id)  # ordered before it was in sight
        if self.state not in UNDER_WAY:
            if anew or (before and before.mission_id != seen.mission_id):
                self._find(seen)
        elif harm := rules.harm_in(seen, self._mission_id, self._world, self._expected, self._over):
            code, text = harm
            self._end(code, f"{text} {self._where()}", now_ns)
        elif started:
            self._begin(seen, now_ns)
        elif self._aim.awaited:
            self._aim.ahead(self.leg)
        while self.leg < onboard and self.state in (FLYING, State.HELD):
            # Kept there, and lost here; there may be more at once than cloud's socket has room for.
            how = "known on board to be reached"
            self._advance(how, now_ns, aim=self.leg + 1 == onboard)
        while self.state is FLYING and self._watch.is_reached(legs[self.leg], seen, now_ns):
            self._advance("reached", now_ns)
        if anew and told is self._aim.setpoint:
            self._aim.again(starting=self.state is STARTING)

    def handle_deadline(self, now_ns: int) -> None:
        """Check the limits of time and repeat the request that is due at `now_ns` [ns]."""
        if self.state in UNDER_WAY:
            elapsed, flown = self.elapsed(now_ns), self._watch.flown
            if late := overdue(self._plan, self.leg, self.state, elapsed, flown):
                self._end(*late, now_ns)
        if (request := self.requests.due(now_ns)) is not None:
            self.outputs.append(request)

    def _find(self, seen: Seen) -> None:
        """Without a mission: what flies is held; what stands, for one lost here, shall stay."""
        told = seen.mission_id
        over = self._is_ended(told) or rules.stands_ready(seen)
        if told != self._mission_id and over and not self.requests.stopping:
            self.requests.ask(Request.END, after=True)
        self._aim.here()

    def _start(self, plan: Plan, mission_id: int, now_ns: int, *, again: bool = False) -> None:
        self.state = STARTING
        self.outcome = None
        self.leg = 0
        self._plan = plan
        self._mission_id = mission_id
        self._continued = None
        self._again = again and plan.start is Start.SPAWN  # from here, what is reached counts
        self._began_ns = now_ns
        here = None if plan.start is Start.SPAWN else self._seen
        self._world = here.world if here else rules.ANY_WORLD
        self._expected = (here.mission_id, mission_id) if here else ()
        if self._seen and again and rules.is_over(self._seen, mission_id, self._over):
            code, text = rules.END_LOST
            self._end(code, f"{text} {self._where()}", now_ns)
            return
        self.requests.report(mission_id, 0)
        self.requests.ask(Request.START, plan.start, after=True)
        self._aim.begin(plan, mission_id)
        self._aim.ahead(0)

    def _go_on(self, before: Continue, now_ns: int) -> None:
        """Start again from here, at the waypoint that was flown to."""
        self.state = STARTING
        self.outcome = None
        self.leg = before.leg
        self._plan = before.plan
        self._mission_id = before.mission_id
        self._continued = before
        self._began_ns = now_ns - round(before.elapsed * 1e9)
        self._world = before.world
        self._expected = (before.mission_id,)
        self.requests.report(self._mission_id, self.leg)
        self.requests.ask(Request.START, Start.HERE)
        self._aim.begin(before.plan, before.mission_id, before)
        if self._seen:
            self.see(self._seen, now_ns)  # it may be over, or the world another one

    def _begin(self, seen: Seen, now_ns: int) -> None:
        """The robot is seen to have started: the clocks of mission and leg begin."""
        plan, before = self._plan, self._continued
        self.state = FLYING
        self._expected = (self._mission_id,)
        self._world = seen.world
        self._watch.begin()
        if before is not None:
            if before.held:
                self._hold(now_ns)
                return
            text = f"resumed after a restart of teleop {self._where()}"
            self._tell("resumed", self.leg, text, now_ns)
            return
        self._began_ns = now_ns
        self._aim.started(self.leg)
        place = "the spawn" if plan.start is Start.SPAWN else "here"
        text = f"mission started from {place}, waypoints: {len(plan.legs)}"
        self._tell("started", 0, text, now_ns)

    def _advance(self, how: str, now_ns: int, *, aim: bool = True) -> None:
        """The waypoint is reached: on to the next, or done; `aim` at it unless more are reached."""
        text = f"{where(self._plan, self.leg)} {how} at {self.elapsed(now_ns):.2f} s"
        self._tell("reached", self.leg, text, now_ns)
        self.leg += 1
        self.requests.report(self._mission_id, self.leg)
        if self.leg < len(self._plan.legs):
            self._watch.begin()
            if self.state is FLYING and aim:
                self._aim.at(self.leg)
        else:
            self._end("done", f"mission done at {self.elapsed(now_ns):.2f} s", now_ns)

    def _hold(self, now_ns: int) -> None:
        self.state = State.HELD
        self._aim.here()
        self._tell("held", self.leg, f"held {self._where()}", now_ns)

    def _resume(self, now_ns: int) -> None:
        self.state = State.FLYING
        self._watch.pause()
        self._aim.at(self.leg)
        self._tell("resumed", self.leg, f"resumed {self._where()}", now_ns)

    def _go_to(self, leg: Leg, mission_id: int, now_ns: int) -> None:
        x, y, z = leg.position
        self._tell("goto", rules.NO_WAYPOINT, f"go to ({x:.2f}, {y:.2f}, {z:.2f}) m", now_ns)
        if self.state is State.HELD:
            self._aim.at_point(leg.position, leg.yaw)
        else:
            self._start(Plan((leg,), Start.HERE, leg.time_limit), mission_id, now_ns)

    def _end(self, code: str, text: str, now_ns: int) -> None:
        """However the mission ends, the robot is asked to hold where it is."""
        waypoint = min(self.leg, len(self._plan.legs) - 1)
        self.state = rules.ENDS.get(code, State.FAILED)
        self.outcome = Outcome(code, text, waypoint, reached=self.leg)
        if code != "done" and self._mission_id:
            self.requests.report(self._mission_id, MISSION_OVER)
        on_ground = self._seen is not None and self._seen.guard is GuardState.GROUND
        if code != "taken_over" or on_ground:  # where it would scrape along
            self.requests.ask(Request.END)
        else:
            self.requests.forget()  # what flies is not ours to end
        self._aim.here()
        self._tell(code, waypoint, text, now_ns)

    @property
    def _over(self) -> int:
        """So many waypoints known on board mean that the mission is over."""
        before = self._again and self.state is STARTING
        return len(self._plan.legs) if before else MISSION_OVER

    def _tell(self, event: str, waypoint: int, text: str, now_ns: int) -> None:
        self.outputs.append(MissionEvent(now_ns, event, waypoint, text))

    def _where(self) -> str:
        return f"on the way to {where(self._plan, self.leg)}"
