"""Fly missions: turn the operator's verbs and telemetry into setpoints and requests.

`Teleop` is a pure state machine (`State`) that exchanges only messages with controller and robot:

    teleop.see(seen, now_ns)            for every new telemetry
    teleop.start(now_ns, plan), ...     for every verb of the operator
    teleop.handle_deadline(now_ns)      regularly, at 10 Hz or faster
    teleop.take_outputs()               after each of them: Setpoint, OperatorRequest, MissionEvent

A `Setpoint` is valid until the next one, within its session. An `OperatorRequest` is repeated at
10 Hz until telemetry shows that the robot has acted on it. Each `MissionEvent` is sent once.

An emergency stop is the request `ALARM` without a number; cloud numbers the request and repeats it.
Teleop sends `ALARM` to cloud at 10 Hz, before all other messages, until telemetry shows the stop.

              start                    start seen             every waypoint reached
        IDLE -------------> STARTING -------------> FLYING --------------------------> DONE
    (or any end)                                hold | ^ resume
                                                     v |
                                                     HELD

Cancel leads from STARTING, FLYING and HELD to CANCELLED. A time limit, a restart of world, a guard
in LAND or an emergency stop lead to FAILED. At every end teleop asks the robot to hold and leaves
the setpoint at the robot's position. For a teleop that restarts, the robot stores the number of
reached waypoints and whether the mission is over. Times are on the caller's clock [ns].

As soon as anybody arms the robot, it flies to the last setpoint. So teleop sends the first waypoint
before telemetry shows the start only if the robot cannot fly to a wrong place.

The time of a leg counts only while the robot flies on cloud's commands. It does not count while the
link is silent, while the guard holds, or while the robot stands on the ground.
"""

from __future__ import annotations

from collections.abc import Callable
from math import dist

from cloudrc.errors import BadInputError
from cloudrc.geometry import fence
from cloudrc.messages import MISSION_OVER, NEVER_NS, GuardState, Request, Setpoint, Start, Vector
from cloudrc.records import MissionEvent
from cloudrc.teleop.requests import REPEAT_NS, RequestSender
from cloudrc.teleop.wire import (
    ALARM,
    NO_PLAN,
    Continue,
    Leg,
    Outcome,
    Output,
    Plan,
    RobotStatus,
    State,
)

WORST_GUARD = GuardState.HOLD
"""Last state of the guard, in the order of `GuardState`, in which a mission continues."""
ANY_WORLD = ""
"""World of a mission that has not started yet: the mission may start in any world."""
HELD_LOWEST = fence.LOW[2] + fence.FLOOR_MARGIN
"""Lowest height of a hold setpoint [m]; at lower heights the robot would scrape along the floor.
Source: docs/safety.md, "The guard"."""
NO_WAYPOINT = -1
"""Waypoint index of a setpoint or event without a waypoint."""
UNDER_WAY = (State.FLYING, State.STARTING, State.HELD)
"""States of a mission that has begun and not ended."""
ENDS = {"done": State.DONE, "cancelled": State.CANCELLED}
"""Code of an outcome -> state of the mission at its end; all other codes lead to FAILED."""
END_LOST = "end_lost", "the robot reports that the mission is over, but its outcome is lost;"
INACTIVE = tuple(state for state in State if state not in UNDER_WAY)

_RULES: dict[str, tuple[tuple[State, ...], str]] = {
    "start": (INACTIVE, "cancel it first"),
    "continue": ((State.IDLE,), "teleop has already flown a mission"),
    "hold": ((State.FLYING,), "it must be flying"),
    "resume": ((State.HELD,), "it must be held"),
    "cancel": (UNDER_WAY, "no mission is under way"),
    "goto": ((State.HELD, *INACTIVE), "hold or cancel it first"),
    "acknowledge": (INACTIVE, "the robot flies a mission"),
    "pause": (UNDER_WAY, "no mission is under way"),
}
"""Verb -> states that allow the verb, and the reason for the refusal in other states. An emergency
stop is always allowed."""


def reached_on_board(seen: RobotStatus, mission_id: int) -> int:
    """Return how many waypoints of a mission the robot has stored as reached."""
    return seen.reached if seen.mission_id == mission_id != 0 else 0


class SetpointSelector:
    """Choose the setpoint: a waypoint of the mission, a point, or the robot's position.

    Attributes:
        setpoint: The last setpoint; None before the first.
        is_pending: Whether the mission's first setpoint has not been sent yet.
    """

    def __init__(self, requests: RequestSender, send: Callable[[Setpoint], None]) -> None:
        """Begin without a mission.

        Args:
            requests: The requests to the robot; their `waits` tells whether the robot waits.
            send: Sends a setpoint.
        """
        self.setpoint: Setpoint | None = None
        self.is_pending = False
        self._requests = requests
        self._send = send
        self._seen: RobotStatus | None = None
        self._plan = NO_PLAN
        self._mission_id = 0
        self._continued = False
        self._stays = False  # whether waypoints are ignored

    def see(self, seen: RobotStatus) -> bool:
        """Note the newest telemetry.

        Returns:
            Whether this telemetry is the first of its session.
        """
        before, self._seen = self._seen, seen
        return before is None or (before.epoch, before.world) != (seen.epoch, seen.world)

    def begin(self, plan: Plan, mission_id: int, before: Continue | None = None) -> None:
        """Begin a mission; if it is continued and held, send no setpoint before it is resumed.

        Args:
            plan: Plan of the mission.
            mission_id: Number of the mission on board; 0 if it has none.
            before: State before the restart of teleop; None for a new mission.
        """
        self._plan = plan
        self._mission_id = mission_id
        self._continued = before is not None
        self.is_pending = before is None or not before.held

    def select_early(self, leg: int) -> None:
        """Select the waypoint before telemetry shows the start, so that the first command is right.

        The method does nothing yet if the mission begins at the spawn and the robot may still fly
        an earlier mission whose end request was lost: the robot would fly to the waypoint at once.

        Args:
            leg: Index of the current waypoint as known to teleop; the robot may have reached later
                waypoints.
        """
        seen, from_spawn = self._seen, self._from_spawn
        if not self.is_pending or seen is None or (from_spawn and not self._requests.waits):
            return
        self.is_pending = False
        onboard = reached_on_board(seen, self._mission_id)
        leg = 0 if from_spawn else max(leg, onboard)
        if leg < len(self._plan.legs):
            self.select_leg(leg)

    def repeat(self, *, starting: bool) -> None:
        """Send the setpoint again in a new session, because cloud forgets it with the old session.

        A mission that begins at the spawn and has not started yet gets the robot's position as
        setpoint, unless the robot waits.

        Args:
            starting: Whether teleop still waits for the start of the mission.
        """
        if starting and self._from_spawn and not self._requests.waits:
            self.is_pending = True
            self.select_here()
        elif self.setpoint is not None:
            self._select(self.setpoint)

    def confirm_start(self, leg: int) -> None:
        """Select the waypoint with this index after the start, unless it has been sent already."""
        if self.is_pending:
            self.is_pending = False
            self.select_leg(leg)

    def select_leg(self, leg: int) -> None:
        """Select the waypoint with this index, unless the robot has to stay."""
        to = self._plan.legs[leg]
        if not self._stays:
            self._select(Setpoint(to.position, to.yaw, leg))

    def select_point(self, position: Vector, yaw: float) -> None:
        """Select a point: `position` [m], world frame, shape (3,); `yaw` [rad]."""
        self._select(Setpoint(position, yaw, NO_WAYPOINT))

    def select_here(self) -> None:
        """Select the robot's position, if telemetry has arrived."""
        if self._seen is not None:
            x, y, z = self._seen.position
            yaw = 0.0 if self.setpoint is None else self.setpoint.yaw
            self.select_point((x, y, max(z, HELD_LOWEST)), yaw)

    def stay(self) -> None:
        """Select the robot's position and ignore all waypoints from now on."""
        self.select_here()
        self._stays = True

    @property
    def _from_spawn(self) -> bool:
        """Whether the mission begins at the spawn; a continued mission does not."""
        return self._plan.start is Start.SPAWN and not self._continued

    def _select(self, setpoint: Setpoint) -> None:
        epoch = 0 if self._seen is None else self._seen.epoch
        self.setpoint = setpoint._replace(epoch=epoch)
        self._send(self.setpoint)


GAP_MAX_NS = 500_000_000
"""Limit of the time of flight that counts between two telemetry messages [ns]."""
UNSEEN_MAX_NS = 2_000_000_000
"""Longest gap between two telemetry messages [ns] after which the time near the waypoint still
continues; after a longer gap this time starts at zero."""
GROUND, HOLD = GuardState.GROUND, GuardState.HOLD  # looked up with every telemetry


class LegWatch:
    """Measure the time of a leg and detect when its waypoint is reached."""

    def __init__(self) -> None:
        self.begin()

    def begin(self) -> None:
        """Begin a new leg."""
        self._flown_ns = 0
        self.pause()

    def pause(self) -> None:
        """Interrupt the leg: keep the time of flight, but reset the time near the waypoint."""
        self._seen_ns = self._near_since_ns = NEVER_NS

    @property
    def flown(self) -> float:
        """Time of flight of this leg [s]."""
        return self._flown_ns * 1e-9

    def is_reached(self, leg: Leg, seen: RobotStatus, now_ns: int) -> bool:
        """Return whether the robot has been near the waypoint for the leg's dwell time.

        Args:
            leg: The current leg.
            seen: The newest telemetry.
            now_ns: Arrival of the telemetry [ns].
        """
        before_ns, self._seen_ns = self._seen_ns, now_ns
        if seen.guard is HOLD:
            self._near_since_ns = NEVER_NS
            return False
        if before_ns >= 0:
            if seen.guard is not GROUND:  # where it waits until it may take off
                self._flown_ns += min(now_ns - before_ns, GAP_MAX_NS)
            if now_ns - before_ns > UNSEEN_MAX_NS:
                self._near_since_ns = NEVER_NS  # the robot's path in the gap is unknown
        if dist(seen.position, leg.position) > leg.tolerance:
            self._near_since_ns = NEVER_NS
            return False
        if self._near_since_ns < 0:
            self._near_since_ns = now_ns
        return now_ns - self._near_since_ns >= leg.dwell * 1e9


# Looking up an enum's member is slow, and these are used in every period.
FLYING, STARTING = State.FLYING, State.STARTING


class Teleop:
    """Fly missions one after the other.

    Attributes:
        state: State of the mission.
        leg: Index of the current waypoint; the number of waypoints once all are reached.
        outcome: How the mission ended; None before the first mission and during a mission.
        requests: Requests to the robot.
        stopping: Whether an emergency stop is pending: telemetry does not show it yet.
        outputs: Messages since the last `take_outputs`.
    """

    def __init__(self, ended: Callable[[int], bool] = lambda mission_id: False) -> None:
        """Begin without a mission; `ended` returns whether the mission with a number is over."""
        self.state = State.IDLE
        self.outcome: Outcome | None = None
        self.requests = RequestSender()
        self.stopping = False
        self._stop_ns = 0
        self._stopped_before: tuple[int, int] | None = None  # see `stop`
        self.outputs: list[Output] = []
        self.leg = 0
        self._is_ended = ended
        self._seen: RobotStatus | None = None
        self._plan = NO_PLAN
        self._mission_id = 0
        self._may_be_flown = False  # whether an earlier teleop may have flown this mission
        self._continued: Continue | None = None  # state before a restart of teleop
        self._world = ANY_WORLD  # in which it was started
        self._expected: tuple[int, ...] = ()  # missions that may be on board; empty: any
        self._began_ns = 0
        self._watch = LegWatch()
        # A lambda, because every `take_outputs` replaces the list.
        self._setpoints = SetpointSelector(
            self.requests, lambda setpoint: self.outputs.append(setpoint)
        )

    @property
    def settled(self) -> bool:
        """Whether telemetry shows that the robot has acted on the last request."""
        return self.requests.settled and not self.stopping

    def elapsed(self, now_ns: int) -> float:
        """Return the time since the mission began [s]."""
        return (now_ns - self._began_ns) * 1e-9

    def take_outputs(self) -> list[Output]:
        """Return the messages since the last call, oldest first."""
        outputs, self.outputs = self.outputs, []
        return outputs

    # The operator's verbs: each raises a BadInputError, and changes nothing, if the state of the
    # mission does not allow it.

    def start(self, now_ns: int, plan: Plan, mission_id: int = 0, *, again: bool = False) -> None:
        """Fly a plan.

        Args:
            now_ns: Own clock [ns].
            plan: Plan of the mission.
            mission_id: Number under which the robot stores the progress; 0 to store none.
            again: Whether an earlier teleop may have flown the mission. If it is over, teleop does
                not fly it again.
        """
        self._check("start")
        self._order(plan, mission_id, now_ns)
        # A mission from here keeps the waypoints that were reached.
        self._may_be_flown = again and plan.start is Start.SPAWN
        here = None if plan.start is Start.SPAWN else self._seen
        self._world = here.world if here else ANY_WORLD
        self._expected = (here.mission_id, mission_id) if here else ()
        if self._seen and again and reached_on_board(self._seen, mission_id) >= self._over:
            code, text = END_LOST
            self._end(code, f"{text} {self._where()}", now_ns)
            return
        self.requests.report(mission_id, 0)
        self.requests.ask(Request.START, plan.start, after=True)
        self._setpoints.begin(plan, mission_id)
        self._setpoints.select_early(0)

    def continue_mission(self, now_ns: int, before: Continue) -> None:
        """Take over a mission of an earlier teleop at its current waypoint; do not reset world."""
        self._check("continue")
        self._order(before.plan, before.mission_id, now_ns - round(before.elapsed * 1e9))
        self.leg, self._continued, self._world = before.leg, before, before.world
        self._expected = (before.mission_id,)
        self.requests.report(self._mission_id, self.leg)
        self.requests.ask(Request.START, Start.HERE)
        self._setpoints.begin(before.plan, before.mission_id, before)
        if self._seen:
            self.see(self._seen, now_ns)  # the mission may be over, or the world another one

    def go_to(self, now_ns: int, position: Vector, yaw: float = 0.0, mission_id: int = 0) -> None:
        """Fly to a point.

        If a mission is held, the point is the new place to hold. Otherwise the point is a mission
        with one waypoint that starts at the robot's position.

        Args:
            now_ns: Own clock [ns].
            position: The point [m], world frame, shape (3,).
            yaw: Heading to hold [rad].
            mission_id: See `start`.
        """
        self._check("goto")
        leg, (x, y, z) = Leg(position, yaw), position
        self._report("goto", NO_WAYPOINT, f"go to ({x:.2f}, {y:.2f}, {z:.2f}) m", now_ns)
        if self.state is State.HELD:
            self._setpoints.select_point(position, yaw)
        else:
            self.start(now_ns, Plan((leg,), Start.HERE, leg.time_limit), mission_id)

    def hold(self, now_ns: int) -> None:
        """Hold the robot at its position and interrupt the mission, at `now_ns` [ns]."""
        self._check("hold")
        self._hold(now_ns)

    def resume(self, now_ns: int) -> None:
        """Continue the held leg, at `now_ns` [ns]."""
        self._check("resume")
        self.state = State.FLYING
        self._watch.pause()
        self._setpoints.select_leg(self.leg)
        self._report("resumed", self.leg, f"resumed {self._where()}", now_ns)

    def cancel(self, now_ns: int) -> None:
        """End the mission, at `now_ns` [ns]."""
        self._check("cancel")
        self._end("cancelled", "mission cancelled", now_ns)

    def stop(self, now_ns: int) -> None:
        """Stop the rotors at once, and drop all earlier requests to the robot.

        If the robot is already stopped, it may be about to act on an acknowledgement. So its state
        ESTOP alone is no proof of the new stop: telemetry has to show a new request, too.

        Args:
            now_ns: Own clock [ns].
        """
        if self.state in UNDER_WAY:
            self._end("emergency_stopped", f"emergency stop {self._where()}", now_ns)
        self.requests.forget()
        seen = self._seen
        stopped = seen is not None and seen.guard is GuardState.ESTOP
        self._stopped_before = (seen.epoch, seen.mission) if seen and stopped else None
        self.stopping, self._stop_ns = True, 0

    def acknowledge(self, now_ns: int) -> None:
        """Allow the robot to fly again after a landing or a stop, at `now_ns` [ns]."""
        self._check("acknowledge")
        self.requests.ask(Request.ACKNOWLEDGE, after=True)

    def pause(self, now_ns: int) -> None:
        """Ask the robot to hold, at `now_ns` [ns], until the next teleop continues the mission."""
        self._check("pause")
        self._report("paused", self.leg, f"paused by shutdown {self._where()}", now_ns)
        self.requests.ask(Request.END)
        self._setpoints.stay()  # cloud keeps this setpoint if the request is lost

    def _check(self, verb: str) -> None:
        allowed, why = _RULES[verb]
        if self.state not in allowed:
            raise BadInputError(f"{verb}: the mission is {self.state.name}; {why}")

    def see(self, seen: RobotStatus, now_ns: int) -> None:
        """Process new telemetry at its arrival `now_ns` [ns]."""
        before, self._seen = self._seen, seen
        if seen.guard is GuardState.ESTOP and (seen.epoch, seen.mission) != self._stopped_before:
            self.stopping = False
        new_session = self._setpoints.see(seen)
        last = self._setpoints.setpoint
        onboard, legs = reached_on_board(seen, self._mission_id), self._plan.legs
        started = self.requests.see(seen, now_ns) is Request.START and self.state is STARTING
        if self.state is STARTING and not self._expected and self._plan.start is Start.HERE:
            # The order came before the first telemetry.
            self._expected = (seen.mission_id, self._mission_id)
        if self.state not in UNDER_WAY:
            if new_session or (before and before.mission_id != seen.mission_id):
                self._stop_foreign_mission(seen)
        elif failure := self._find_failure(seen):
            code, text = failure
            self._end(code, f"{text} {self._where()}", now_ns)
        elif started:
            self._begin(seen, now_ns)
        elif self._setpoints.is_pending:
            self._setpoints.select_early(self.leg)
        while self.leg < onboard and self.state in (FLYING, State.HELD):
            # The robot kept what teleop lost. Only the last waypoint is selected, because cloud's
            # socket might not have room for all setpoints at once.
            how = "reached, as the robot reports,"
            self._advance(how, now_ns, select=self.leg + 1 == onboard)
        while self.state is FLYING and self._watch.is_reached(legs[self.leg], seen, now_ns):
            self._advance("reached", now_ns)
        if new_session and last is self._setpoints.setpoint:
            self._setpoints.repeat(starting=self.state is STARTING)

    def handle_deadline(self, now_ns: int) -> None:
        """Check the time limits and repeat the request that is due at `now_ns` [ns]."""
        if self.state in UNDER_WAY and (timeout := self._find_timeout(now_ns)):
            self._end(*timeout, now_ns)
        if self.stopping:
            if now_ns >= self._stop_ns:
                self._stop_ns = now_ns + REPEAT_NS
                self.outputs.append(ALARM)
        elif (request := self.requests.due(now_ns)) is not None:
            self.outputs.append(request)

    def _find_failure(self, seen: RobotStatus) -> tuple[str, str] | None:
        """Find a failure in telemetry that ends the mission; return its code and its text."""
        if self._world not in (ANY_WORLD, seen.world):
            return "world_restarted", "world restarted"
        if self._expected and seen.mission_id not in self._expected:
            return "taken_over", "somebody else has started another mission"
        if reached_on_board(seen, self._mission_id) >= self._over:
            return END_LOST
        if seen.guard > WORST_GUARD:
            return "guard_stopped", f"guard went to {seen.guard.name} ({seen.cause.words})"
        return None

    def _find_timeout(self, now_ns: int) -> tuple[str, str] | None:
        """Find an exceeded time limit; return its code and its text, or None."""
        limit, leg_limit = self._plan.time_limit, self._plan.legs[self.leg].time_limit
        if self.elapsed(now_ns) >= limit and self.state is STARTING:
            return "timed_out", f"the robot has not started within {limit:g} s; is the link up?"
        if self.elapsed(now_ns) >= limit:
            return "timed_out", f"mission not done within {limit:g} s: {self._where()}"
        if self._watch.flown >= leg_limit and self.state is FLYING:
            return "leg_timed_out", f"{self._leg_name()} not reached in {leg_limit:g} s"
        return None

    def _stop_foreign_mission(self, seen: RobotStatus) -> None:
        """Keep the robot from flying a mission that this teleop does not fly.

        The setpoint becomes the robot's position. If the robot stands on the ground, or if its
        mission has ended, teleop also asks the robot to end the mission.
        """
        mission_id = seen.mission_id
        may_take_off = seen.guard is GROUND and mission_id != 0
        over = self._is_ended(mission_id) or may_take_off
        if mission_id != self._mission_id and over and not self.stopping:
            self.requests.ask(Request.END, after=True)
        self._setpoints.select_here()

    def _order(self, plan: Plan, mission_id: int, began_ns: int) -> None:
        """Store a new mission: its plan, its number, and the start of its time."""
        self.state, self.outcome, self.leg = STARTING, None, 0
        self._plan, self._mission_id, self._began_ns = plan, mission_id, began_ns
        self._continued, self._may_be_flown = None, False

    def _begin(self, seen: RobotStatus, now_ns: int) -> None:
        """Begin the mission after telemetry shows its start; start the times of mission and leg."""
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
            self._report("resumed", self.leg, text, now_ns)
            return
        self._began_ns = now_ns
        self._setpoints.confirm_start(self.leg)
        place = "the spawn" if plan.start is Start.SPAWN else "here"
        text = f"mission started from {place}, waypoints: {len(plan.legs)}"
        self._report("started", 0, text, now_ns)

    def _advance(self, how: str, now_ns: int, *, select: bool = True) -> None:
        """Go on to the next waypoint or end the mission; with `select`, select the waypoint."""
        text = f"{self._leg_name()} {how} at {self.elapsed(now_ns):.2f} s"
        self._report("reached", self.leg, text, now_ns)
        self.leg += 1
        self.requests.report(self._mission_id, self.leg)
        if self.leg < len(self._plan.legs):
            self._watch.begin()
            if self.state is FLYING and select:
                self._setpoints.select_leg(self.leg)
        else:
            self._end("done", f"mission done at {self.elapsed(now_ns):.2f} s", now_ns)

    def _hold(self, now_ns: int) -> None:
        self.state = State.HELD
        self._setpoints.select_here()
        self._report("held", self.leg, f"held {self._where()}", now_ns)

    def _end(self, code: str, text: str, now_ns: int) -> None:
        """End the mission, and ask the robot to hold its position."""
        waypoint = min(self.leg, len(self._plan.legs) - 1)
        self.state = ENDS.get(code, State.FAILED)
        self.outcome = Outcome(code, text, reached=self.leg)
        if code != "done" and self._mission_id:
            self.requests.report(self._mission_id, MISSION_OVER)
        on_ground = self._seen is not None and self._seen.guard is GuardState.GROUND
        if code != "taken_over" or on_ground:  # on the ground it would scrape along the floor
            self.requests.ask(Request.END)
        else:
            self.requests.forget()  # another teleop's mission must not be ended
        self._setpoints.select_here()
        self._report(code, waypoint, text, now_ns)

    @property
    def _over(self) -> int:
        """Smallest number of waypoints stored on board that means: the mission is over."""
        may_be_flown = self._may_be_flown and self.state is STARTING
        return len(self._plan.legs) if may_be_flown else MISSION_OVER

    def _report(self, event: str, waypoint: int, text: str, now_ns: int) -> None:
        self.outputs.append(MissionEvent(now_ns, event, waypoint, text))

    def _where(self) -> str:
        return f"on the way to {self._leg_name()}"

    def _leg_name(self) -> str:
        return f"waypoint {self.leg + 1} of {len(self._plan.legs)}"
