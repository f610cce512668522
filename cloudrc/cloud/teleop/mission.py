"""The mission: operator's verbs and the robot as seen come in; setpoints and requests go out.

A pure state machine (`State`), joined to controller and robot by messages only:

    teleop.see(seen, now_ns)            with every telemetry that becomes the newest
    teleop.operate(verb, now_ns)        when the operator says something
    teleop.handle_deadline(now_ns)      regularly, at 10 Hz or faster
    teleop.take_outputs()               after any of them: Setpoint, OperatorRequest, MissionEvent

A `Setpoint` holds until the next; an `OperatorRequest` comes out at 10 Hz until the robot is seen
to have acted on it; each `MissionEvent` comes out once.

              StartMission             start seen             every waypoint reached
        IDLE -------------> STARTING -------------> FLYING --------------------------> DONE
    (or any end)                                Hold | ^ Resume
                                                     v |
                                                     HELD

Cancel leads from STARTING, FLYING and HELD to CANCELLED; a limit of time, a world that restarts,
a guard that lands or an emergency stop lead to FAILED. Every end holds: the robot is asked to hold
by itself, and the setpoint stays where it was seen. The robot keeps in mind, too, how many
waypoints are reached, for a teleop that forgets. Times are nanoseconds of the caller's clock.
"""

from __future__ import annotations

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
from cloudrc.cloud.teleop.mission_leg import LegWatch
from cloudrc.cloud.teleop.plan import Leg, Plan
from cloudrc.cloud.teleop.request import Repeater
from cloudrc.errors import BadInputError
from cloudrc.messages import ZERO, GuardState, Request, Setpoint, Start, Vector
from cloudrc.records import MissionEvent

# An enum's member is slow to look up; these are asked for in every period.
FLYING, WORST_GUARD = State.FLYING, GuardState.HOLD
UNDER_WAY = (FLYING, State.STARTING, State.HELD)
NO_WAYPOINT = -1
ANY_WORLD = ""
"""Until the robot is seen to have started it does not matter which world it stands in."""
NO_PLAN = Plan((Leg(ZERO),))
"""Stands in until the first mission starts; never flown."""


class Teleop:
    """Flies missions, one after the other.

    Attributes:
        state: Of the mission.
        outcome: How it ended; None while there is none or it is under way.
        requests: What is asked of the robot.
        outputs: What it has said since the last `take_outputs`.
    """

    def __init__(self) -> None:
        self.state = State.IDLE
        self.outcome: Outcome | None = None
        self.requests = Repeater()
        self.outputs: list[Output] = []
        self._seen: Seen | None = None
        self._plan, self._mission_id = NO_PLAN, 0
        self._leg, self._watch = 0, LegWatch()
        self._world = ANY_WORLD
        self._continued: Continue | None = None
        self._yaw = 0.0
        self._began_ns = 0

    @property
    def leg(self) -> int:
        """Index of the waypoint that is flown to; the number of waypoints once all are reached."""
        return self._leg

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
        match verb:
            case StartMission(plan, mission_id):
                self._refuse_unless("start", self.state not in UNDER_WAY, "cancel it first")
                self._start(plan, mission_id, now_ns)
            case Continue():
                self._refuse_unless("continue", self.state is State.IDLE, "it is not the first")
                self._go_on(verb, now_ns)
            case Hold():
                self._refuse_unless("hold", self.state is State.FLYING, "it has to be flying")
                self._hold(now_ns)
            case Resume():
                self._refuse_unless("resume", self.state is State.HELD, "it has to be held")
                self._resume(now_ns)
            case Cancel():
                self._refuse_unless("cancel", self.state in UNDER_WAY, "there is none under way")
                self._end(State.CANCELLED, "cancelled", "mission cancelled", now_ns)
            case GoTo(position, yaw):
                leg = Leg(position, yaw)
                moving = self.state in (State.STARTING, State.FLYING)
                self._refuse_unless("goto", not moving, "hold or cancel it first")
                self._go_to(leg, now_ns)
            case EmergencyStop():
                if self.state in UNDER_WAY:
                    self._fail("emergency_stopped", f"emergency stop {self._where()}", now_ns)
                self.requests.ask(Request.ESTOP)
            case Acknowledge():
                self._refuse_unless("acknowledge", self.state not in UNDER_WAY, "it flies")
                self.requests.ask(Request.ACKNOWLEDGE, after=True)
            case Pause():
                self._refuse_unless("pause", self.state in UNDER_WAY, "there is none under way")
                self._tell("paused", self._leg, f"paused by shutdown {self._where()}", now_ns)
                self.requests.ask(Request.END)

    def see(self, seen: Seen, now_ns: int) -> None:
        """Take note of the newest telemetry, at the instant [ns] at which it arrives."""
        before, self._seen = self._seen, seen
        started = self.requests.see(seen) is Request.START and self.state is State.STARTING
        if self.state not in UNDER_WAY:
            if before is None or seen.epoch != before.epoch:
                self._aim(seen.position, self._yaw, NO_WAYPOINT)
        elif self._world not in (ANY_WORLD, seen.world):
            self._fail("world_restarted", f"world restarted {self._where()}", now_ns)
        elif started:
            self._begin(now_ns)
        elif seen.guard > WORST_GUARD:
            self._fail("guard_stopped", f"guard went to {seen.guard.name} {self._where()}", now_ns)
        if seen.reached > self._leg and seen.mission_id == self._mission_id != 0:
            self._catch_up(seen.reached, now_ns)
        while self.state is FLYING and self._watch.is_reached(self._to, seen, now_ns):
            self._advance("reached", now_ns)

    def handle_deadline(self, now_ns: int) -> None:
        """Check the limits of time and repeat the request that is due at `now_ns` [ns]."""
        if self.state in UNDER_WAY:
            self._check_time(now_ns)
        request = self.requests.due(now_ns)
        if request is not None:
            self.outputs.append(request)

    def _start(self, plan: Plan, mission_id: int, now_ns: int) -> None:
        self.state, self.outcome = State.STARTING, None
        self._plan, self._leg, self._continued = plan, 0, None
        self._mission_id, self._began_ns = mission_id, now_ns
        seen = self._seen
        self._world = seen.world if seen and plan.start is Start.HERE else ANY_WORLD
        self.requests.report(mission_id, 0)
        self.requests.ask(Request.START, plan.start)
        # Already now, so that the first command that the started robot gets leads the right way.
        self._aim_at_leg()

    def _go_on(self, before: Continue, now_ns: int) -> None:
        """Start again from here, at the waypoint that was flown to."""
        self.state, self.outcome = State.STARTING, None
        self._plan, self._leg, self._continued = before.plan, before.leg, before
        self._mission_id, self._world = before.mission_id, before.world
        self._began_ns = now_ns - round(before.elapsed * 1e9)
        self.requests.report(self._mission_id, self._leg)
        self.requests.ask(Request.START, Start.HERE)
        if not before.held:
            self._aim_at_leg()

    def _begin(self, now_ns: int) -> None:
        """The robot is seen to have started: the clocks of mission and leg begin."""
        plan, before = self._plan, self._continued
        self.state = State.FLYING
        self._watch.begin()
        if self._seen is not None:
            self._world = self._seen.world
        if before is not None:
            text = f"resumed after a restart of teleop {self._where()}"
            self._tell("resumed", self._leg, text, now_ns)
            if before.held:
                self._hold(now_ns)
            return
        self._began_ns = now_ns
        where = "from the spawn" if plan.start is Start.SPAWN else "from here"
        self._tell("started", 0, f"mission started {where}, waypoints: {len(plan.legs)}", now_ns)

    @property
    def _to(self) -> Leg:
        """The leg that is flown."""
        return self._plan.legs[self._leg]

    def _catch_up(self, reached: int, now_ns: int) -> None:
        """More is reached than is known here: it was kept on board, and lost here."""
        while self._leg < reached and self.state in (FLYING, State.HELD):
            self._advance("known on board to be reached", now_ns)

    def _advance(self, how: str, now_ns: int) -> None:
        """The waypoint is reached: on to the next, or done."""
        index, count = self._leg, len(self._plan.legs)
        text = f"{self._waypoint_text()} {how} at {self.elapsed(now_ns):.2f} s"
        self._tell("reached", index, text, now_ns)
        self._leg += 1
        self.requests.report(self._mission_id, self._leg)
        if self._leg < count:
            self._watch.begin()
            if self.state is FLYING:
                self._aim_at_leg()
        else:
            text = f"mission done at {self.elapsed(now_ns):.2f} s"
            self._end(State.DONE, "done", text, now_ns)

    def _hold(self, now_ns: int) -> None:
        self.state = State.HELD
        self._aim_here()
        self._tell("held", self._leg, f"held {self._where()}", now_ns)

    def _resume(self, now_ns: int) -> None:
        self.state = State.FLYING
        self._watch.pause()
        self._aim_at_leg()
        self._tell("resumed", self._leg, f"resumed {self._where()}", now_ns)

    def _go_to(self, leg: Leg, now_ns: int) -> None:
        x, y, z = leg.position
        self._tell("goto", NO_WAYPOINT, f"go to ({x:.2f}, {y:.2f}, {z:.2f}) m", now_ns)
        if self.state is State.HELD:
            self._aim(leg.position, leg.yaw, NO_WAYPOINT)
        else:
            self._start(Plan((leg,), Start.HERE, leg.time_limit), 0, now_ns)

    def _check_time(self, now_ns: int) -> None:
        limit = self._plan.time_limit
        if now_ns - self._began_ns >= limit * 1e9:
            if self.state is State.STARTING:
                text = f"the robot has not started within {limit:g} s; is the link up?"
            else:
                text = f"mission not done within {limit:g} s: {self._where()}"
            self._fail("timed_out", text, now_ns)
        elif self.state is FLYING and self._watch.flown >= self._to.time_limit:
            text = f"{self._waypoint_text()} not reached in {self._to.time_limit:g} s"
            self._fail("leg_timed_out", text, now_ns)

    def _fail(self, code: str, text: str, now_ns: int) -> None:
        self._end(State.FAILED, code, text, now_ns)

    def _end(self, state: State, code: str, text: str, now_ns: int) -> None:
        """However the mission ends, the robot is asked to hold where it is."""
        waypoint = min(self._leg, len(self._plan.legs) - 1)
        self.state = state
        self.outcome = Outcome(code, text, waypoint, reached=self._leg)
        self.requests.ask(Request.END)
        self._aim_here()
        self._tell(code, waypoint, text, now_ns)

    def _aim_at_leg(self) -> None:
        self._aim(self._to.position, self._to.yaw, self._leg)

    def _aim_here(self) -> None:
        if self._seen is not None:
            self._aim(self._seen.position, self._yaw, NO_WAYPOINT)

    def _aim(self, position: Vector, yaw: float, waypoint: int) -> None:
        self._yaw = yaw
        self.outputs.append(Setpoint(position, yaw, waypoint))

    def _tell(self, event: str, waypoint: int, text: str, now_ns: int) -> None:
        self.outputs.append(MissionEvent(now_ns, event, waypoint, text))

    def _waypoint_text(self) -> str:
        return f"waypoint {self._leg + 1} of {len(self._plan.legs)}"

    def _where(self) -> str:
        return f"on the way to {self._waypoint_text()}"

    def _refuse_unless(self, verb: str, allowed: bool, why: str) -> None:
        if not allowed:
            raise BadInputError(f"{verb}: the mission is {self.state.name}; {why}")
