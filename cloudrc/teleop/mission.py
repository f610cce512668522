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

What a mission bears: verbs that do not fit its state are refused, harm that is seen ends it.

Where a mission aims: the robot as seen and the legs come in, setpoints go out.

A robot flies to what was aimed at last as soon as it is armed, whoever has armed it. So a mission
aims before its start is seen only if the robot cannot leave at once for the wrong place.

One leg as it is flown: the robot as seen comes in; whether it is there, or late, goes out.

Only time in which the robot is seen to fly on the cloud's commands counts: while the link is silent
or the guard holds, and on the ground, it does not do what the leg is for, and waits.
"""

from __future__ import annotations

from collections.abc import Callable
from math import dist

from cloudrc.errors import BadInputError
from cloudrc.geometry import fence
from cloudrc.messages import MISSION_OVER, NEVER_NS, GuardState, Request, Setpoint, Start, Vector
from cloudrc.records import MissionEvent
from cloudrc.teleop.requests import Repeater
from cloudrc.teleop.wire import (
    NO_PLAN,
    Acknowledge,
    Cancel,
    Continue,
    EmergencyStop,
    GoTo,
    Hold,
    Leg,
    Outcome,
    Output,
    Pause,
    Plan,
    Resume,
    Seen,
    StartMission,
    State,
    Verb,
)

WORST_GUARD = GuardState.HOLD
ANY_WORLD = ""
"""Until the robot is seen to have started it does not matter which world it stands in."""
HELD_LOWEST = fence.LOW[2] + fence.FLOOR_MARGIN
"""No robot is held lower [m]: it would scrape along the floor. One that has not taken off yet does,
and is held there. Source: docs/safety.md, "The guard"."""
NO_WAYPOINT = -1
UNDER_WAY = (State.FLYING, State.STARTING, State.HELD)
ENDS = {"done": State.DONE, "cancelled": State.CANCELLED}
"""By their codes; every other one is a failure."""
END_LOST = "end_lost", "the robot knows it to be over, how it ended was not kept;"
RESTS = tuple(state for state in State if state not in UNDER_WAY)

_RULES: dict[type[Verb], tuple[str, tuple[State, ...], str]] = {
    StartMission: ("start", RESTS, "cancel it first"),
    Continue: ("continue", (State.IDLE,), "it is not the first"),
    Hold: ("hold", (State.FLYING,), "it has to be flying"),
    Resume: ("resume", (State.HELD,), "it has to be held"),
    Cancel: ("cancel", UNDER_WAY, "there is none under way"),
    GoTo: ("goto", (State.HELD, *RESTS), "hold or cancel it first"),
    Acknowledge: ("acknowledge", RESTS, "it flies"),
    Pause: ("pause", UNDER_WAY, "there is none under way"),
}
"""Of each verb: its name, the states that allow it, and what is wrong with the others; an
emergency stop is allowed in every state."""


def refuse_unless_fitting(verb: Verb, state: State) -> None:
    """Let a verb pass that fits the state of the mission.

    Raises:
        BadInputError: If it does not.
    """
    name, allowed, why = _RULES.get(type(verb), ("", (state,), ""))
    if state not in allowed:
        raise BadInputError(f"{name}: the mission is {state.name}; {why}")


def held_at(seen: Seen, before: Setpoint | None) -> Setpoint:
    """Where a robot is held that is seen there; it looks as it was told before."""
    x, y, z = seen.position
    yaw = 0.0 if before is None else before.yaw
    return Setpoint((x, y, max(z, HELD_LOWEST)), yaw, NO_WAYPOINT)


def known_on_board(seen: Seen, mission_id: int) -> int:
    """How many waypoints of a mission the robot knows to be reached."""
    return seen.reached if seen.mission_id == mission_id != 0 else 0


def is_over(seen: Seen, mission_id: int, over: int) -> bool:
    """Whether the robot knows a mission to be over; `over` waypoints reached mean that."""
    return known_on_board(seen, mission_id) >= over


def stands_ready(seen: Seen) -> bool:
    """Whether the robot stands on the ground, told of a mission: it may take off for that."""
    return seen.guard is GuardState.GROUND and seen.mission_id != 0


def harm_in(
    seen: Seen, mission_id: int, world: str, expected: tuple[int, ...], over: int
) -> tuple[str, str] | None:
    """Say what ends a mission that is under way, if anything seen does: code and text.

    Args:
        seen: The newest telemetry.
        mission_id: Of the mission.
        world: In which it was started, or `ANY_WORLD`.
        expected: Missions that may be on board: this one, once the robot has been told of it, or
            before that the one that a mission from here has found; empty if it may be any.
        over: See `is_over`.
    """
    if world not in (ANY_WORLD, seen.world):
        return "world_restarted", "world restarted"
    if expected and seen.mission_id not in expected:
        return "taken_over", "somebody else has started another mission"
    if is_over(seen, mission_id, over):
        return END_LOST
    if seen.guard > WORST_GUARD:
        return "guard_stopped", f"guard went to {seen.guard.name} ({seen.cause.words})"
    return None


class Aim:
    """Aims at the mission's waypoints, or at where the robot is seen.

    Attributes:
        setpoint: The last one; None before the first.
        awaited: Whether a mission is to be aimed as soon as that leads the right way.
    """

    def __init__(self, requests: Repeater, say: Callable[[Setpoint], None]) -> None:
        """Begin without a mission.

        Args:
            requests: What is asked of the robot; tells whether it waits.
            say: Gets every setpoint.
        """
        self.setpoint: Setpoint | None = None
        self.awaited = False
        self._requests = requests
        self._say = say
        self._seen: Seen | None = None
        self._plan = NO_PLAN
        self._mission_id = 0
        self._continued = False
        self._stays = False  # leads nowhere any more

    def see(self, seen: Seen) -> bool:
        """Take note of the newest telemetry.

        Returns:
            Whether it is the first of its session.
        """
        before, self._seen = self._seen, seen
        return before is None or before.epoch != seen.epoch

    def begin(self, plan: Plan, mission_id: int, before: Continue | None = None) -> None:
        """A mission begins; one that goes on and is held aims at nothing before it is resumed.

        Args:
            plan: Whose waypoints are aimed at.
            mission_id: Names it on board; 0 for not at all.
            before: How it stood, if it goes on.
        """
        self._plan = plan
        self._mission_id = mission_id
        self._continued = before is not None
        self.awaited = before is None or not before.held

    def ahead(self, leg: int) -> None:
        """Aim before the start is seen: the first command that is flown then leads the right way.

        Not while the robot may still fly a mission whose end was lost: it would leave at once, past
        the spawn, for a waypoint that is to be flown to from there.

        Args:
            leg: Index of the waypoint, as far as teleop knows; the robot may know of more.
        """
        seen, from_spawn = self._seen, self._from_spawn
        if not self.awaited or seen is None or (from_spawn and not self._requests.waits):
            return
        self.awaited = False
        onboard = known_on_board(seen, self._mission_id)
        leg = 0 if from_spawn else max(leg, onboard)
        if leg < len(self._plan.legs):
            self.at(leg)

    def again(self, *, starting: bool) -> None:
        """Cloud forgets the setpoint with its session: somebody else may have moved the robot.

        Args:
            starting: Whether the mission's start has not been seen yet.
        """
        if starting and self._from_spawn and not self._requests.waits:
            self.awaited = True
            self.here()
        elif self.setpoint is not None:
            self._aim(self.setpoint)

    def started(self, leg: int) -> None:
        """The start is seen: what is not aimed yet aims at the waypoint of this index."""
        if self.awaited:
            self.awaited = False
            self.at(leg)

    def at(self, leg: int) -> None:
        """Aim at the waypoint of this index, unless the robot is to stay."""
        to = self._plan.legs[leg]
        if not self._stays:
            self._aim(Setpoint(to.position, to.yaw, leg))

    def at_point(self, position: Vector, yaw: float) -> None:
        """Aim at a point that is no waypoint: position [m], world frame, shape (3,); yaw [rad]."""
        self._aim(Setpoint(position, yaw, NO_WAYPOINT))

    def here(self) -> None:
        """Aim at where the robot is seen, if it is."""
        if self._seen is not None:
            self._aim(held_at(self._seen, self.setpoint))

    def stay(self) -> None:
        """Aim at where the robot is seen, and at no waypoint from now on."""
        self.here()
        self._stays = True

    @property
    def _from_spawn(self) -> bool:
        """Whether the robot is put to the spawn first; one that goes on is not."""
        return self._plan.start is Start.SPAWN and not self._continued

    def _aim(self, setpoint: Setpoint) -> None:
        epoch = 0 if self._seen is None else self._seen.epoch
        self.setpoint = setpoint._replace(epoch=epoch)
        self._say(self.setpoint)


GAP_MAX_NS = 500_000_000
"""Of a longer silence between two telemetries only so much counts as flown [ns]."""
UNSEEN_MAX_NS = 2_000_000_000
"""After a longer one nobody knows where the robot was meanwhile [ns]."""
GROUND, HOLD = GuardState.GROUND, GuardState.HOLD  # looked up with every telemetry


class LegWatch:
    """Watches the robot on its way to a waypoint."""

    def __init__(self) -> None:
        self.begin()

    def begin(self) -> None:
        """A new leg begins."""
        self._flown_ns = 0
        self.pause()

    def pause(self) -> None:
        """The leg is not flown for a while: the time flown is kept, the time near is not."""
        self._seen_ns = self._near_since_ns = NEVER_NS

    @property
    def flown(self) -> float:
        """How long the leg has been flown [s]."""
        return self._flown_ns * 1e-9

    def is_reached(self, leg: Leg, seen: Seen, now_ns: int) -> bool:
        """True once the robot has been seen near the waypoint for as long as the leg asks.

        Args:
            leg: That is flown.
            seen: The newest telemetry.
            now_ns: When it arrived [ns].
        """
        before_ns, self._seen_ns = self._seen_ns, now_ns
        if seen.guard is HOLD:
            self._near_since_ns = NEVER_NS
            return False
        if before_ns >= 0:
            if seen.guard is not GROUND:  # where it waits until it may take off
                self._flown_ns += min(now_ns - before_ns, GAP_MAX_NS)
            if now_ns - before_ns > UNSEEN_MAX_NS:
                self._near_since_ns = NEVER_NS  # where it was meanwhile nobody knows
        if dist(seen.position, leg.position) > leg.tolerance:
            self._near_since_ns = NEVER_NS
            return False
        if self._near_since_ns < 0:
            self._near_since_ns = now_ns
        return now_ns - self._near_since_ns >= leg.dwell * 1e9


def where(plan: Plan, leg: int) -> str:
    """Say which waypoint is flown to."""
    return f"waypoint {leg + 1} of {len(plan.legs)}"


def overdue(
    plan: Plan, leg: int, state: State, elapsed: float, flown: float
) -> tuple[str, str] | None:
    """Say which limit of time is over, if one is: code and text.

    Args:
        plan: Of the mission.
        leg: Index of the waypoint that is flown to.
        state: Of the mission, which is under way.
        elapsed: Since the mission began, or was asked for [s].
        flown: How long the leg has been flown [s].
    """
    limit, leg_limit = plan.time_limit, plan.legs[leg].time_limit
    if elapsed >= limit and state is State.STARTING:
        return "timed_out", f"the robot has not started within {limit:g} s; is the link up?"
    if elapsed >= limit:
        text = f"mission not done within {limit:g} s: on the way to {where(plan, leg)}"
        return "timed_out", text
    if flown >= leg_limit and state is State.FLYING:
        return "leg_timed_out", f"{where(plan, leg)} not reached in {leg_limit:g} s"
    return None


# An enum's member is slow to look up; these are asked for in every period.
FLYING, STARTING = State.FLYING, State.STARTING


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
        self._world = ANY_WORLD  # in which it was started
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
        refuse_unless_fitting(verb, self.state)
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
        onboard, legs = known_on_board(seen, self._mission_id), self._plan.legs
        started = self.requests.see(seen, now_ns) is Request.START and self.state is STARTING
        if self.state is STARTING and not self._expected and self._plan.start is Start.HERE:
            self._expected = (seen.mission_id, self._mission_id)  # ordered before it was in sight
        if self.state not in UNDER_WAY:
            if anew or (before and before.mission_id != seen.mission_id):
                self._find(seen)
        elif harm := harm_in(seen, self._mission_id, self._world, self._expected, self._over):
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
        over = self._is_ended(told) or stands_ready(seen)
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
        self._world = here.world if here else ANY_WORLD
        self._expected = (here.mission_id, mission_id) if here else ()
        if self._seen and again and is_over(self._seen, mission_id, self._over):
            code, text = END_LOST
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
        self._tell("goto", NO_WAYPOINT, f"go to ({x:.2f}, {y:.2f}, {z:.2f}) m", now_ns)
        if self.state is State.HELD:
            self._aim.at_point(leg.position, leg.yaw)
        else:
            self._start(Plan((leg,), Start.HERE, leg.time_limit), mission_id, now_ns)

    def _end(self, code: str, text: str, now_ns: int) -> None:
        """However the mission ends, the robot is asked to hold where it is."""
        waypoint = min(self.leg, len(self._plan.legs) - 1)
        self.state = ENDS.get(code, State.FAILED)
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
