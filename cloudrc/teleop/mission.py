# SPDX-License-Identifier: Apache-2.0

"""Fly missions: turn the operator's commands and telemetry into setpoints, requests and events.

              start                    start seen             every waypoint reached
        IDLE -------------> STARTING -------------> FLYING --------------------------> DONE
    (or any end)                                hold | ^ resume
                                                     v |
                                                     HELD

The command cancel leads from STARTING, FLYING and HELD to CANCELLED. A time limit, a restart of
world, a guard in LAND or an emergency stop leads to FAILED. At the end of a mission teleop asks the
robot to hold. The request may be late or lost; therefore teleop also makes the robot's position the
setpoint.

A carrot is a setpoint that moves to the next waypoint. Its motion depends on time alone, so that
the link's delay does not change the duration of a mission. The carrot leaves a waypoint only if
telemetry shows the robot near the waypoint. While the guard ignores cloud's commands, a carrot, or
a setpoint that is driven by hand, stays at the robot.
"""

from __future__ import annotations

from collections.abc import Callable
from math import dist
from typing import TYPE_CHECKING, Literal

from cloudrc.base.text import describe_point
from cloudrc.physics.geometry.fence import Fence
from cloudrc.results.metrics.verdict import Ending
from cloudrc.teleop.aim import NO_WAYPOINT, Aim
from cloudrc.teleop.carrot import HEARTBEAT_NS
from cloudrc.teleop.refusals import ConflictError
from cloudrc.teleop.requests import REPEAT_NS, RequestSender
from cloudrc.teleop.route import GAP_MAX_NS, Route
from cloudrc.teleop.wire import (
    ALARM,
    FLYING,
    HELD,
    STARTING,
    STATES,
    Leg,
    Output,
    RobotStatus,
)
from cloudrc.wire.messages import (
    MISSION_OVER,
    NEVER_NS,
    ZERO,
    Cause,
    GuardState,
    Motion,
    Request,
    Start,
    Vector,
)
from cloudrc.wire.records import MissionEnd, MissionEvent, MissionFailure, MissionState, UnderWay

if TYPE_CHECKING:
    from cloudrc.teleop.store import MissionRecord

UNDER_WAY: tuple[MissionState, ...] = FLYING, STARTING, HELD
"""States of a mission that has begun and has not ended."""
GIVE_UP_NS = 5_000_000_000
"""Longest time for which teleop tries to tell the robot that the mission has ended [ns]."""
GROUND, TRACK, HOLD, _, ESTOP = GuardState  # to look up a member takes time


class MissionFlight:
    """The flight of one mission.

    Attributes:
        plan: What the mission flies.
        route: The way to the current waypoint.
        number: Identifies the mission on board; 0: the robot stores no progress.
        state: State of the mission.
        outcome: Event that has ended the mission; None before.
        ending: Its code and text.
    """

    def __init__(
        self,
        now_ns: int,
        mission: MissionRecord,
        aim: Aim,
        requests: RequestSender,
        tell: Callable[[MissionEvent], object],
        is_ended: Callable[[int], bool],
    ) -> None:
        """Ask the robot to start; `tell` gets each event.

        `is_ended` tells whether a number is that of a mission of this operator that has ended.
        If an earlier teleop process has begun the mission, continue at its waypoint.
        """
        self.plan, self.number, self._id = mission.order.plan, mission.number, mission.id
        self.route = Route(self.plan, mission.waypoint, aim)
        self.state: MissionState = STARTING
        self.outcome: MissionEvent | None = None
        self.ending: Ending | None = None
        self._aim, self._requests, self._tell, self._is_ended = aim, requests, tell, is_ended
        self._began_ns = now_ns - round(mission.elapsed * 1e9)
        # Whether an earlier teleop has begun the mission, and whether it was held then.
        self._continued, self._was_held = bool(mission.world), mission.state == HELD
        self._from_spawn = self.plan.start is Start.SPAWN and not self._continued
        self._is_pending = not self._was_held  # whether the first setpoint has not been sent yet
        self._released_ns = NEVER_NS  # end of the wait for a request to drive; or NEVER_NS
        # Process of world in which the mission started; "": any. Numbers that the robot may
        # report; empty: any.
        self._world, self._expected = mission.world, tuple[int, ...]()
        aim.begin(self.plan)
        requests.begin(self.number, self.route.leg, touch=mission.order.touched or "")
        if self._continued:
            self._expected = (self.number,)
            requests.ask(Request.START, Start.HERE)
            return
        if self.plan.start is Start.HERE and (here := aim.seen):
            self._world, self._expected = here.world, (here.mission_id, self.number)
        requests.ask(Request.START, self.plan.start, after=True)

    def elapsed(self, now_ns: int) -> float:
        """Return the time since the mission began [s]."""
        return (now_ns - self._began_ns) * 1e-9

    def go_to(self, now_ns: int, leg: Leg) -> None:
        """Fly to a point; raise ConflictError if the mission is not in the state `HELD`."""
        self._check("goto", HELD)
        self._report("goto", f"go to {describe_point(leg.position)} m", now_ns, NO_WAYPOINT)
        self._aim.select_point(leg)

    def hold(self, now_ns: int) -> None:
        """Hold the robot at its position; raise ConflictError unless the mission flies."""
        if not self._is_driven:
            self._check("hold", FLYING)
        self._aim.select_here()
        self._report("held", f"held {self.route.where}", now_ns)

    def drive(self, now_ns: int, velocity: Vector, yaw_rate: float | None = None) -> None:
        """Move the setpoint with `velocity` [m/s], world frame, for at most `HEARTBEAT_NS`.

        With a `yaw_rate` [rad/s] it also turns, and `velocity` is in the frame of its heading.

        The mission must be held; a hand-driven mission may also be starting. In other states,
        raise a ConflictError. The call has no effect while the mission starts, or while telemetry
        does not show that the robot follows commands.
        """
        if self.plan.by_hand and self.state == STARTING:
            return
        self._check("drive", HELD)
        seen, aim = self._aim.seen, self._aim
        assert seen is not None, "telemetry has shown the start"
        if seen.guard is not TRACK or now_ns - aim.seen_ns > GAP_MAX_NS:
            return
        moves = velocity != ZERO or bool(yaw_rate)
        if moves and not self._is_driven:
            self._report("driving", "driven by hand", now_ns, NO_WAYPOINT)
        self._released_ns = now_ns + HEARTBEAT_NS if moves else NEVER_NS
        aim.steer(velocity, now_ns, yaw_rate)

    def resume(self, now_ns: int) -> None:
        """Continue a held mission; raise ConflictError unless the mission is held."""
        self._check("resume", HELD)
        self.route.pause()
        self.route.select(now_ns)
        self._report("resumed", f"resumed {self.route.where}", now_ns)

    def pause(self, now_ns: int) -> None:
        """Ask the robot to hold until the next teleop process continues the mission."""
        self._report("paused", f"paused by shutdown {self.route.where}", now_ns)
        self._requests.ask(Request.END)
        self._aim.select_here()  # cloud keeps this setpoint if the request is lost
        self._aim.stays = True

    def end(self, now_ns: int, code: MissionEnd, text: str) -> None:
        """End the mission, and ask the robot to hold; report the event `code` with its `text`."""
        seen, requests = self._aim.seen, self._requests
        if code != "done" and self.number:
            requests.report(self.number, MISSION_OVER)
        on_ground = seen is not None and seen.guard is GROUND
        if code != "taken_over" or on_ground:  # commands would drag a robot along the ground
            requests.ask(Request.END)
        else:
            requests.forget()  # the new mission must not end
        self._aim.select_here()
        self.ending = Ending(code, text)
        self.outcome = self._report(code, text, now_ns)

    def see(self, seen: RobotStatus, now_ns: int, confirmed: Request | None) -> None:
        """Begin, go on or end as telemetry shows; `confirmed` is the request that it confirms."""
        if self.state == STARTING and not self._expected and self.plan.start is Start.HERE:
            # The mission was ordered before the first telemetry.
            self._expected = (seen.mission_id, self.number)
        if failure := self._find_failure(seen):
            code, text = failure
            self.end(now_ns, code, f"{text} {self.route.where}")
        elif self.state == STARTING and confirmed is Request.START:
            self._begin(seen, now_ns)
        elif self._is_pending:
            self._select_early(now_ns)
        self._follow_route(seen, now_ns)

    def handle_deadline(self, now_ns: int) -> None:
        """Check the time limits, and move the setpoint along a track."""
        limit = self.plan.time_limit
        if (now_ns - self._began_ns) * 1e-9 >= limit and self.state in UNDER_WAY:
            text = f"mission not done within {limit:g} s (time_limit_s): {self.route.where}"
            if self.state == STARTING:
                text = f"the robot has not started within {limit:g} s (time_limit_s)"
                text += "; is the link up?"
            self.end(now_ns, "timed_out", text)
        elif self.state == FLYING:
            if text := self.route.timeout():
                self.end(now_ns, "leg_timed_out", text)
            elif self.plan.track:
                self._aim.follow(self._began_ns, now_ns)
        if NEVER_NS < self._released_ns <= now_ns and self._is_driven:
            self._released_ns = NEVER_NS
            text = f"no request to drive for {HEARTBEAT_NS * 1e-9:g} s: the robot brakes and holds"
            self._report("operator_lost", text, now_ns, NO_WAYPOINT)

    def repeat_setpoint(self, now_ns: int) -> None:
        """Send the setpoint again, because a new session has begun.

        Send the robot's position instead if the operator steers by hand, or if the mission still
        has to reset the robot to the spawn.
        """
        aim, setpoint = self._aim, self._aim.setpoint
        if self.state == STARTING and self._from_spawn and not self._requests.waits:
            self._is_pending = True
            aim.select_here()
        elif self._is_driven:
            aim.select_here()
        elif setpoint is not None and type(setpoint.motion) is Motion:
            aim.select_leg(setpoint.waypoint, now_ns)
        elif setpoint is not None:
            aim.select(setpoint)

    @property
    def _is_driven(self) -> bool:
        """Whether the operator has moved the setpoint of the held mission by hand."""
        return self.state == HELD and self._aim.is_driven

    @property
    def _onboard(self) -> int:
        """Number of waypoints of this mission that the robot has stored as reached."""
        seen = self._aim.seen
        return seen.reached if seen and seen.mission_id == self.number != 0 else 0

    def _check(self, verb: str, needed: MissionState) -> None:
        if self.state != needed:
            text = f"{verb}: the mission is {self.state}; it must be {needed}"
            raise ConflictError(text, self._id)

    def _find_failure(self, seen: RobotStatus) -> tuple[MissionFailure, str] | None:
        """Return an event's code and text if telemetry shows that the mission fails, else None."""
        if self._world not in ("", seen.world):
            return "world_restarted", "world restarted"
        is_other = bool(self._expected) and seen.mission_id not in self._expected
        # A robot that has not started yet may report an earlier mission of this operator.
        if is_other and not (self.state == STARTING and self._is_ended(seen.mission_id)):
            return "taken_over", "somebody else has started another mission"
        repeated = self.state == STARTING and self._from_spawn  # after an earlier teleop
        if self._onboard >= (len(self.plan.legs) if repeated else MISSION_OVER):
            text = "the robot reports that the mission is over, but its outcome is lost;"
            return "end_lost", text
        if seen.guard > HOLD:
            has_failed = seen.cause is Cause.FAILED
            code: MissionFailure = "onboard_failed" if has_failed else "guard_stopped"
            return code, f"guard went to {seen.guard.name} ({seen.cause.words})"
        return None

    def _begin(self, seen: RobotStatus, now_ns: int) -> None:
        """Begin the mission, now that telemetry shows that the robot has started."""
        self._world, self._expected = seen.world, (self.number,)
        if not self._continued:
            self._began_ns = now_ns
            if self._is_pending:
                self._is_pending = False
                self.route.select(now_ns)
            place = "the spawn" if self.plan.start is Start.SPAWN else "here"
            text = f"mission started from {place}, {self.plan.contents}"
            if self.plan.unit == "waypoint":
                text += f", judged by the {self.plan.judged_by} position"
            self._report("started", text, now_ns)
        if self._was_held or self.plan.by_hand:
            self._aim.select_here()
            self._report("held", f"held {self.route.where}", now_ns)
        elif self._continued:
            text = f"resumed after a restart of teleop {self.route.where}"
            self._report("resumed", text, now_ns)

    def _follow_route(self, seen: RobotStatus, now_ns: int) -> None:
        """Go on to the next waypoint if the robot has reached one; move the setpoint."""
        onboard, legs, track = self._onboard, self.plan.legs, self.plan.track
        while self.route.leg < onboard and self.state in (FLYING, HELD):
            self._advance("reached, as the robot reports,", now_ns)  # the event was lost
        if self.state == FLYING and legs[self.route.leg].speed:
            self.route.lead(seen, now_ns)
        if seen.guard is not TRACK and self._is_driven:
            self._aim.select_here()
        if track:
            # The report judges by the true position whether the robot is near enough: one measured
            # position is too noisy.
            if self.state == FLYING and self.elapsed(now_ns) >= track[-1][0]:
                away = dist(seen.position, track[-1][1])
                how = f"flown to their end, {away:.2f} m from the last one"
                self._advance("is over" if self.plan.follow else how, now_ns)
            return
        while self.state == FLYING and self.route.is_reached(seen, now_ns):
            self._advance("over" if self.plan.unit == "step" else "reached", now_ns)

    def _advance(self, how: str, now_ns: int) -> None:
        self._report("reached", f"{self.route.name} {how}", now_ns)
        begin = self.route.advance(now_ns)
        self._requests.report(self.number, self.route.leg)
        if self.route.leg == len(self.plan.legs):
            self.end(now_ns, "done", "mission done")
        elif self.state == FLYING and self.route.leg >= self._onboard:  # never fly back
            self.route.select(*begin)

    def _select_early(self, now_ns: int) -> None:
        """Select the first waypoint before telemetry shows that the mission began, to save time.

        If the mission begins with a reset to the spawn, first wait until the robot ignores
        commands; otherwise the robot would fly to the waypoint before the reset.
        """
        if self._from_spawn and not self._requests.waits:
            return
        self._is_pending = False
        leg = 0 if self._from_spawn else max(self.route.leg, self._onboard)
        if leg < len(self.plan.legs):
            self._aim.select_leg(leg, now_ns)

    def _report(
        self,
        code: Literal[UnderWay, MissionEnd],
        text: str,
        now_ns: int,
        waypoint: int | None = None,
    ) -> MissionEvent:
        """Tell an event, by default one of the current waypoint; the last one stays current."""
        if waypoint is None:
            waypoint = min(self.route.leg, len(self.plan.legs) - 1)
        self.state = STATES.get(code, self.state)
        event = MissionEvent(now_ns, code, waypoint, text)
        self._tell(event)
        return event


class Teleop:
    """Flies missions one after the other.

    Call `see` for new telemetry, and `handle_deadline` at 10 Hz or faster. The operator's commands
    are methods of `flight`. After each call, send the messages of `take_outputs`. A setpoint is
    valid until the next setpoint or session. All times `now_ns` are on the caller's clock [ns].

    Attributes:
        flight: The newest mission; None before the first.
        aim: The setpoint.
        outputs: Messages for cloud since the last `take_outputs`.
        stopping: Whether telemetry has not yet shown a requested ESTOP.
    """

    def __init__(
        self, fence: Fence, ended: Callable[[int], bool] = lambda mission_id: False
    ) -> None:
        """Begin without a mission, in a scene with `fence`.

        `ended(n)` tells whether the mission with number n has ended.
        """
        self.outputs: list[Output] = []
        self.aim = Aim(fence, self.outputs.append)
        self.flight: MissionFlight | None = None
        self.requests, self._is_ended = RequestSender(), ended
        self.stopping, self._stop_ns, self._now_ns = False, 0, 0

    @property
    def seen(self) -> RobotStatus | None:
        """The newest telemetry; None before the first."""
        return self.aim.seen

    @property
    def settled(self) -> bool:
        """Whether telemetry shows that the robot has acted on the last request."""
        return self.requests.settled and not self.stopping

    @property
    def over(self) -> bool:
        """Whether the mission has ended, and the robot knows it or has not confirmed it for 5 s."""
        ended = self.flight and self.flight.outcome
        if not ended:
            return False
        return self.settled or self._now_ns - ended.stamp_ns > GIVE_UP_NS

    def take_outputs(self) -> list[Output]:
        """Return and remove the messages for cloud since the last call, oldest first."""
        outputs = self.outputs[:]
        self.outputs.clear()
        return outputs

    def start(self, now_ns: int, mission: MissionRecord) -> None:
        """Fly a mission; if an earlier teleop process has begun it, continue at its waypoint.

        The robot stores the progress under the mission's number, unless this number is 0.
        """
        parts = self.aim, self.requests, self.outputs.append, self._is_ended
        self.flight = MissionFlight(now_ns, mission, *parts)
        if self.seen:  # an earlier teleop may have flown the mission, or world has restarted
            self.see(self.seen, now_ns)

    def stop(self, now_ns: int) -> None:
        """Switch the robot off at once in any state, and drop all earlier requests to the robot.

        Teleop sends `ALARM` to cloud until telemetry shows ESTOP. Cloud then sends the request
        ESTOP to the robot.
        """
        if self.flight and self.flight.state in UNDER_WAY:
            self.flight.end(
                now_ns, "emergency_stopped", f"emergency stop {self.flight.route.where}"
            )
        self.requests.forget()
        self.stopping, self._stop_ns = True, now_ns + REPEAT_NS
        self.outputs.append(ALARM)

    def acknowledge(self) -> None:
        """Allow the robot to fly again after a landing or a stop."""
        self.requests.ask(Request.ACKNOWLEDGE, after=True)

    def see(self, seen: RobotStatus, now_ns: int) -> None:
        """Process telemetry that has arrived at `now_ns`."""
        flight, aim = self.flight, self.aim
        if flight and flight.plan.judged_by == "predicted" and (ahead := seen.control) is not None:
            # It is where the robot will be when the setpoint that follows now reaches it.
            turned = ahead.orientation_wxyz
            seen = seen._replace(position=ahead.position, orientation_wxyz=turned)
        before, aim.seen = aim.seen, seen
        if seen.guard is ESTOP:
            self.stopping = False
        new_session = not before or before.epoch != seen.epoch or before.world != seen.world
        last, confirmed = aim.setpoint, self.requests.see(seen, now_ns)
        if flight and flight.state in UNDER_WAY:
            flight.see(seen, now_ns, confirmed)
        elif new_session or (before and before.mission_id != seen.mission_id):
            self._keep_in_place(seen)
        if flight and new_session and last is aim.setpoint:
            flight.repeat_setpoint(now_ns)
        aim.seen_ns = now_ns

    def _keep_in_place(self, seen: RobotStatus) -> None:
        """Keep the robot at its position: the mission in telemetry may come from another teleop.

        Also request the end of that mission, if the robot stands on the ground, or if this teleop
        knows that the mission has ended.
        """
        mission_id, own = seen.mission_id, self.flight.number if self.flight else 0
        over = self._is_ended(mission_id) or (seen.guard is GROUND and mission_id != 0)
        if mission_id != own and over and not self.stopping:
            self.requests.ask(Request.END, after=True)
        self.aim.select_here()

    def handle_deadline(self, now_ns: int) -> None:
        """Check the time limits, move the setpoint along a track, and repeat a request if due."""
        self._now_ns = now_ns
        if self.flight:
            self.flight.handle_deadline(now_ns)
        if self.stopping:
            if now_ns >= self._stop_ns:
                self._stop_ns = now_ns + REPEAT_NS
                self.outputs.append(ALARM)
        elif (request := self.requests.due(now_ns)) is not None:
            self.outputs.append(request)
