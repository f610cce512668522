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

from bisect import bisect_right
from collections.abc import Callable
from math import degrees, dist
from typing import TYPE_CHECKING

from cloudrc.errors import BadInputError
from cloudrc.geometry.fence import Fence
from cloudrc.geometry.vectors import turn_to
from cloudrc.messages import (
    MISSION_OVER,
    NEVER_NS,
    ZERO,
    Cause,
    Drive,
    GuardState,
    Motion,
    Request,
    Setpoint,
    Start,
    Vector,
)
from cloudrc.records import MissionEvent
from cloudrc.teleop.carrot import ACCELERATION, HEARTBEAT_NS, arrival_ns, steer
from cloudrc.teleop.requests import REPEAT_NS, RequestSender
from cloudrc.teleop.wire import (
    ALARM,
    FLYING,
    HELD,
    NO_PLAN,
    STARTING,
    STATES,
    Leg,
    Output,
    RobotStatus,
)

if TYPE_CHECKING:
    from cloudrc.teleop.store import MissionRecord

NO_WAYPOINT = -1
"""Waypoint index in a setpoint or event that belongs to no waypoint."""
UNDER_WAY = FLYING, STARTING, HELD
"""States of a mission that has begun and has not ended."""
GAP_MAX_NS = 500_000_000
"""Longest gap in telemetry that counts in full as time of flight [ns]. Of a longer gap only this
time counts, and the carrot starts again from the robot."""
PROMPT_NS = 100_000_000
"""Tolerance for late telemetry [ns]. If telemetry shows the robot at the waypoint at most this long
after the planned time, the carrot leaves as planned, else when telemetry shows the robot there."""
UNSEEN_MAX_NS = 2_000_000_000
"""Longest time without telemetry after which the dwell time at a waypoint continues [ns]."""
GIVE_UP_NS = 5_000_000_000
"""Longest time for which teleop tries to tell the robot that the mission has ended [ns]."""
JUMP_SPEED = 6.0
"""Highest speed of the setpoint on a track [m/s]; along a faster part the setpoint jumps."""
GROUND, TRACK, HOLD, _, ESTOP = GuardState  # to look up a member takes time


class LegWatch:
    """Measure the time of flight to a waypoint, and detect when the robot has reached the waypoint.

    Time in which the robot does not follow cloud's commands does not count.
    """

    def __init__(self) -> None:
        self._flown_ns = 0
        self.pause()

    def pause(self) -> None:
        """Interrupt the flight to the waypoint: keep the time flown, but restart the dwell time."""
        self._seen_ns = self._near_since_ns = NEVER_NS

    @property
    def flown(self) -> float:
        """Time for which the robot has flown towards the present waypoint [s]."""
        return self._flown_ns * 1e-9

    def is_reached(self, leg: Leg, seen: RobotStatus, now_ns: int) -> bool:
        """Return whether at `now_ns` [ns] the robot has been at the waypoint for the dwell time."""
        before_ns, self._seen_ns = self._seen_ns, now_ns
        if seen.guard is HOLD:
            self._near_since_ns = NEVER_NS
            return False
        if before_ns >= 0:
            if seen.guard is not GROUND:  # in GROUND the robot waits
                self._flown_ns += min(now_ns - before_ns, GAP_MAX_NS)
            if now_ns - before_ns > UNSEEN_MAX_NS:
                self._near_since_ns = NEVER_NS  # the robot's path in the gap is unknown
        if not (leg.is_at(seen.position) and leg.is_facing(seen.orientation_wxyz)):
            self._near_since_ns = NEVER_NS
            return False
        if self._near_since_ns < 0:
            self._near_since_ns = now_ns
        return now_ns - self._near_since_ns >= leg.dwell * 1e9


class Teleop:
    """State machine that flies missions one after the other.

    Call `see` for new telemetry, `handle_deadline` at 10 Hz or faster, and another method for each
    command of the operator. After each call, send the messages of `take_outputs`. A setpoint is
    valid until the next setpoint or session. All times `now_ns` are on the caller's clock [ns].
    """

    def __init__(
        self, fence: Fence, ended: Callable[[int], bool] = lambda mission_id: False
    ) -> None:
        """Begin without a mission, in a scene with `fence`.

        `ended(n)` tells whether the mission with number n has ended.
        """
        self._fence = fence
        self.state = "idle"  # of the mission
        self.leg = 0  # index of the current waypoint; their number once all are reached
        self.outcome: MissionEvent | None = None  # event that ended the newest mission
        self.seen: RobotStatus | None = None  # newest telemetry
        self.requests = RequestSender()
        self.outputs: list[Output] = []  # since the last `take_outputs`
        self.stopping = False  # whether telemetry has not yet shown a requested ESTOP
        self._stop_ns, self._is_ended = 0, ended
        self._plan, self._mission_id, self._began_ns = NO_PLAN, 0, 0
        self._continued = self._was_held = False  # mission begun, and held, by an earlier teleop
        self._world = ""  # process of world in which the mission started; "": any
        self._expected: tuple[int, ...] = ()  # numbers that the robot may report; empty: any
        self._watch = LegWatch()
        self._setpoint: Setpoint | None = None
        self._is_pending = False  # whether the mission's first setpoint has not been sent yet
        self._stays = False  # whether waypoints are ignored
        self._seen_ns, self._now_ns = NEVER_NS, 0  # times of newest telemetry and deadline
        # Whether the robot has followed commands in this mission, and whether the carrot waits.
        self._followed = self._waits = False
        self._released_ns = NEVER_NS  # end of the wait for a request to drive; or NEVER_NS
        self._knot = -1  # index of the point of the track that the setpoint has left last

    @property
    def settled(self) -> bool:
        """Whether telemetry shows that the robot has acted on the last request."""
        return self.requests.settled and not self.stopping

    @property
    def over(self) -> bool:
        """Whether the mission has ended, and the robot knows it or has not confirmed it for 5 s."""
        ended = self.outcome
        if ended is None:
            return False
        return self.settled or self._now_ns - ended.stamp_ns > GIVE_UP_NS

    def elapsed(self, now_ns: int) -> float:
        """Return the time since the mission began [s]."""
        return (now_ns - self._began_ns) * 1e-9

    def take_outputs(self) -> list[Output]:
        """Return and remove the messages for cloud since the last call, oldest first."""
        outputs, self.outputs = self.outputs, []
        return outputs

    def start(self, now_ns: int, mission: MissionRecord) -> None:
        """Fly a mission; if an earlier teleop process has begun it, continue at its waypoint.

        The robot stores the progress under the mission's number, unless this number is 0.
        """
        self._plan, self._mission_id, self._began_ns = mission.order.plan, mission.number, now_ns
        self.state, self.outcome, self.leg = STARTING, None, mission.waypoint
        self._continued, self._was_held = bool(mission.world), mission.state == HELD
        self._followed = self._waits = False
        self._knot, self._is_pending = -1, not self._was_held
        self.requests.begin(mission.number, self.leg, touch=mission.order.touched or "")
        if self._continued:
            self._began_ns -= round(mission.elapsed * 1e9)
            self._world, self._expected = mission.world, (mission.number,)
            self.requests.ask(Request.START, Start.HERE)
        else:
            here = None if self._plan.start is Start.SPAWN else self.seen
            self._world = here.world if here else ""
            self._expected = (here.mission_id, mission.number) if here else ()
            self.requests.ask(Request.START, self._plan.start, after=True)
        if self.seen:  # an earlier teleop may have flown the mission, or world has restarted
            self.see(self.seen, now_ns)

    def go_to(self, now_ns: int, leg: Leg) -> None:
        """Fly to a point; raise BadInputError if the mission is not in the state `HELD`."""
        self._check("goto", HELD)
        x, y, z = leg.position
        self._report("goto", NO_WAYPOINT, f"go to ({x:.2f}, {y:.2f}, {z:.2f}) m", now_ns)
        self._select(self._setpoint_of(leg, NO_WAYPOINT))

    def hold(self, now_ns: int) -> None:
        """Hold the robot at its position; raise BadInputError unless a mission flies."""
        if not self._drives:
            self._check("hold", FLYING)
        self._hold(now_ns)

    def drive(self, now_ns: int, velocity: Vector) -> None:
        """Move the setpoint with `velocity` [m/s], world frame, for at most `HEARTBEAT_NS`.

        The mission must be held; a hand-driven mission may also be starting. In other states,
        raise a BadInputError. The call has no effect while the mission starts, or while telemetry
        does not show that the robot follows commands.
        """
        if self._plan.by_hand and self.state == STARTING:
            return
        self._check("drive", HELD)
        seen, setpoint = self.seen, self._setpoint
        assert seen is not None, "telemetry has shown the start"
        assert setpoint is not None, "the setpoint is where the robot was held"
        if seen.guard is not TRACK or now_ns - self._seen_ns > GAP_MAX_NS:
            return
        moves = velocity != ZERO
        if moves and not self._drives:
            self._report("driving", NO_WAYPOINT, "driven by hand", now_ns)
        self._released_ns = now_ns + HEARTBEAT_NS if moves else NEVER_NS
        self._select(steer(setpoint, velocity, now_ns, self._fence))

    def resume(self, now_ns: int) -> None:
        """Continue a held mission; raise BadInputError unless the mission is held."""
        self._check("resume", HELD)
        self._watch.pause()
        self._select_leg(self.leg, now_ns)
        self._report("resumed", self.leg, f"resumed {self.where}", now_ns)

    def cancel(self, now_ns: int, text: str = "mission cancelled") -> None:
        """End the mission under way; `text` is the text of the event."""
        self._end("cancelled", text, now_ns)

    def stop(self, now_ns: int) -> None:
        """Switch the robot off at once in any state, and drop all earlier requests to the robot.

        Teleop sends `ALARM` to cloud until telemetry shows ESTOP. Cloud then sends the request
        ESTOP to the robot.
        """
        if self.state in UNDER_WAY:
            self._end("emergency_stopped", "emergency stop", now_ns, where=True)
        self.requests.forget()
        self.stopping, self._stop_ns = True, now_ns + REPEAT_NS
        self.outputs.append(ALARM)

    def acknowledge(self, now_ns: int) -> None:
        """Allow the robot to fly again after a landing or a stop."""
        self.requests.ask(Request.ACKNOWLEDGE, after=True)

    def pause(self, now_ns: int) -> None:
        """Ask the robot to hold until the next teleop process continues the mission."""
        self._report("paused", self.leg, f"paused by shutdown {self.where}", now_ns)
        self.requests.ask(Request.END)
        self._select_here()  # cloud keeps this setpoint if the request is lost
        self._stays = True

    def see(self, seen: RobotStatus, now_ns: int) -> None:
        """Process telemetry that has arrived at `now_ns`."""
        if self._plan.judged_by == "predicted" and (ahead := seen.control) is not None:
            # It is where the robot will be when the setpoint that follows now reaches it.
            turned = ahead.orientation_wxyz
            seen = seen._replace(position=ahead.position, orientation_wxyz=turned)
        before, self.seen = self.seen, seen
        if seen.guard is ESTOP:
            self.stopping = False
        new_session = not before or before.epoch != seen.epoch or before.world != seen.world
        changed = new_session or (before is not None and before.mission_id != seen.mission_id)
        last, onboard = self._setpoint, self._onboard
        self._follow_robot(seen, now_ns, changed=changed)
        self._follow_way(seen, onboard, now_ns)
        if new_session and last is self._setpoint:
            self._repeat_setpoint(now_ns)
        self._seen_ns = now_ns

    def _follow_robot(self, seen: RobotStatus, now_ns: int, *, changed: bool) -> None:
        """Begin or end the mission as telemetry shows.

        If session or mission have `changed` while this teleop has no mission, keep the robot in
        place.
        """
        confirmed = self.requests.see(seen, now_ns)
        started = self.state == STARTING and confirmed is Request.START
        if self.state == STARTING and not self._expected and self._plan.start is Start.HERE:
            # The mission was ordered before the first telemetry.
            self._expected = (seen.mission_id, self._mission_id)
        if self.state not in UNDER_WAY:
            if changed:
                self._stop_foreign_mission(seen)
        elif failure := self._find_failure(seen):
            self._end(*failure, now_ns, where=True)
        elif started:
            self._begin(seen, now_ns)
        elif self._is_pending:
            self._select_early(now_ns)

    def _follow_way(self, seen: RobotStatus, onboard: int, now_ns: int) -> None:
        """Go on to the next waypoint if the robot has reached one; move the setpoint.

        `onboard` is the number of waypoints that the robot has stored as reached.
        """
        legs = self._plan.legs
        while self.leg < onboard and self.state in (FLYING, HELD):
            self._advance("reached, as the robot reports,", now_ns)  # the event was lost
        if self.state == FLYING and legs[self.leg].speed:
            self._lead(seen, now_ns)
        if self._drives and seen.guard is not TRACK:
            self._select_here()
        if self._plan.track:
            self._end_track(seen, now_ns)
            return
        done = "over" if self._plan.unit == "step" else "reached"
        while self.state == FLYING and self._is_reached(legs[self.leg], seen, now_ns):
            self._advance(done, now_ns)

    def handle_deadline(self, now_ns: int) -> None:
        """Check the time limits, move the setpoint along a track, and repeat a request if due."""
        self._now_ns = now_ns
        if self.state in UNDER_WAY and (timeout := self._find_timeout(now_ns)):
            self._end(*timeout, now_ns)
        if self.state == FLYING and self._plan.track:
            self._follow_track(now_ns)
        if self._drives and NEVER_NS < self._released_ns <= now_ns:
            self._released_ns = NEVER_NS
            text = f"no request to drive for {HEARTBEAT_NS * 1e-9:g} s: the robot brakes and holds"
            self._report("operator_lost", NO_WAYPOINT, text, now_ns)
        if self.stopping:
            if now_ns >= self._stop_ns:
                self._stop_ns = now_ns + REPEAT_NS
                self.outputs.append(ALARM)
        elif (request := self.requests.due(now_ns)) is not None:
            self.outputs.append(request)

    def _check(self, verb: str, needed: str) -> None:
        if self.state != needed:
            raise BadInputError(f"{verb}: the mission is {self.state}; it must be {needed}")

    def _find_failure(self, seen: RobotStatus) -> tuple[str, str] | None:
        """Return an event's code and text if telemetry shows that the mission fails, else None."""
        if self._world not in ("", seen.world):
            return "world_restarted", "world restarted"
        if self._expected and seen.mission_id not in self._expected:
            return "taken_over", "somebody else has started another mission"
        repeated = self.state == STARTING and self._from_spawn  # after an earlier teleop
        if self._onboard >= (len(self._plan.legs) if repeated else MISSION_OVER):
            text = "the robot reports that the mission is over, but its outcome is lost;"
            return "end_lost", text
        if seen.guard > HOLD:
            code = "onboard_failed" if seen.cause is Cause.FAILED else "guard_stopped"
            return code, f"guard went to {seen.guard.name} ({seen.cause.words})"
        return None

    def _find_timeout(self, now_ns: int) -> tuple[str, str] | None:
        limit, leg_limit = self._plan.time_limit, self._plan.legs[self.leg].time_limit
        if self.elapsed(now_ns) >= limit:
            if self.state == STARTING:
                return (
                    "timed_out",
                    f"the robot has not started within {limit:g} s (time_limit_s); is the link up?",
                )
            return "timed_out", f"mission not done within {limit:g} s (time_limit_s): {self.where}"
        if self._watch.flown >= leg_limit and self.state == FLYING:
            text = f"{self._leg_name} not reached in {leg_limit:g} s (its time_limit_s)"
            return "leg_timed_out", text + self._describe_turn(self._plan.legs[self.leg])
        return None

    def _describe_turn(self, leg: Leg) -> str:
        """Say by how much the yaw of a robot at a waypoint is wrong; "" if it is not."""
        seen = self.seen
        if seen is None or leg.yaw is None or not leg.is_at(seen.position):
            return ""
        if leg.is_facing(seen.orientation_wxyz):
            return ""
        left = degrees(abs(turn_to(leg.yaw, seen.orientation_wxyz)))
        return f": the robot is there, but its yaw is {left:.0f} deg away"

    def _stop_foreign_mission(self, seen: RobotStatus) -> None:
        """Keep the robot at its position: the mission in telemetry may come from another teleop.

        Also request the end of that mission, if the robot stands on the ground, or if this teleop
        knows that the mission has ended.
        """
        mission_id = seen.mission_id
        over = self._is_ended(mission_id) or (seen.guard is GROUND and mission_id != 0)
        if mission_id != self._mission_id and over and not self.stopping:
            self.requests.ask(Request.END, after=True)
        self._select_here()

    def _begin(self, seen: RobotStatus, now_ns: int) -> None:
        """Begin the mission, now that telemetry shows that the robot has started."""
        self._world, self._expected = seen.world, (self._mission_id,)
        self._watch = LegWatch()
        if not self._continued:
            self._began_ns = now_ns
            if self._is_pending:
                self._is_pending = False
                self._select_leg(self.leg, now_ns)
            place = "the spawn" if self._plan.start is Start.SPAWN else "here"
            text = f"mission started from {place}, {self._plan.contents}"
            if self._plan.unit == "waypoint":
                text += f", judged by the {self._plan.judged_by} position"
            self._report("started", 0, text, now_ns)
        if self._was_held or self._plan.by_hand:
            self._hold(now_ns)
        elif self._continued:
            text = f"resumed after a restart of teleop {self.where}"
            self._report("resumed", self.leg, text, now_ns)

    def _advance(self, how: str, now_ns: int) -> None:
        self._report("reached", self.leg, f"{self._leg_name} {how}", now_ns)
        leaves_ns = self._leaves_ns(self.leg)
        start = None if leaves_ns is None else self._plan.legs[self.leg].position
        self.leg += 1
        self.requests.report(self._mission_id, self.leg)
        if self.leg < len(self._plan.legs):
            self._watch = LegWatch()
            if self.state == FLYING and self.leg >= self._onboard:  # never fly back
                if leaves_ns is None or now_ns - leaves_ns > PROMPT_NS:
                    leaves_ns = now_ns
                self._select_leg(self.leg, leaves_ns, start)
        else:
            self._end("done", "mission done", now_ns)

    def _lead(self, seen: RobotStatus, now_ns: int) -> None:
        """Keep the carrot, a moving setpoint, at the robot while the guard ignores commands.

        After that, let the carrot move on. At the first take-off, the carrot moves before telemetry
        shows that the robot follows commands: this saves a round trip.
        """
        self._followed = self._followed or seen.guard is TRACK
        if seen.guard is not TRACK and (self._followed or seen.guard is not GROUND):
            self._waits = True
            self._select_here()
        elif self._waits or (self._seen_ns >= 0 and now_ns - self._seen_ns > GAP_MAX_NS):
            self._waits = False
            self._select_leg(self.leg, now_ns)

    def _follow_track(self, now_ns: int) -> None:
        """Move the setpoint from point to point of the track, at the times in the track."""
        track = self._plan.track
        knot = bisect_right(track, self.elapsed(now_ns), key=lambda each: each[0]) - 1
        if not self._knot < knot < len(track) - 1:
            return
        self._knot, (begin, start), (end, position) = knot, *track[knot : knot + 2]
        motion, lasts = None, end - begin
        if 0.0 < dist(start, position) <= JUMP_SPEED * lasts:
            x, y, z = ((b - a) / lasts for a, b in zip(start, position, strict=True))
            begin_ns, until_ns = (self._began_ns + round(at * 1e9) for at in (begin, end))
            box = self._fence.inner_low, self._fence.inner_high
            motion = Drive(start, begin_ns, (x, y, z), (x, y, z), ACCELERATION, until_ns, *box)
        self._select(Setpoint(position, waypoint=self.leg, motion=motion))

    def _end_track(self, seen: RobotStatus, now_ns: int) -> None:
        """End the mission after the last setpoint of the track.

        The report judges by the true position whether the robot is near enough: one measured
        position is too noisy.
        """
        lasts, last = self._plan.track[-1]
        if self.state == FLYING and self.elapsed(now_ns) >= lasts:
            away = dist(seen.position, last)
            self._advance(f"flown to their end, {away:.2f} m from the last one", now_ns)

    def _is_reached(self, leg: Leg, seen: RobotStatus, now_ns: int) -> bool:
        rested = self._watch.is_reached(leg, seen, now_ns)
        if not leg.speed:
            return rested
        leaves_ns = self._leaves_ns(self.leg)
        near = leg.is_at(seen.position) and leg.is_facing(seen.orientation_wxyz)
        return near and leaves_ns is not None and now_ns >= leaves_ns

    def _leaves_ns(self, leg: int) -> int | None:
        """Return when the dwell time at waypoint `leg` ends [ns].

        Return None if the present setpoint does not move gradually (`carrot`) to this waypoint.
        """
        setpoint = self._setpoint
        if setpoint is None or type(setpoint.motion) is not Motion or setpoint.waypoint != leg:
            return None
        return arrival_ns(setpoint) + round(self._plan.legs[leg].dwell * 1e9)

    def _hold(self, now_ns: int) -> None:
        self._select_here()
        self._report("held", self.leg, f"held {self.where}", now_ns)

    def _end(self, code: str, text: str, now_ns: int, *, where: bool = False) -> None:
        """End the mission, and ask the robot to hold; report the event `code` with its `text`.

        With `where`, add to the text which waypoint the robot was flying to.
        """
        text = f"{text} {self.where}" if where else text
        waypoint = min(self.leg, len(self._plan.legs) - 1)
        if code != "done" and self._mission_id:
            self.requests.report(self._mission_id, MISSION_OVER)
        on_ground = self.seen is not None and self.seen.guard is GROUND
        if code != "taken_over" or on_ground:  # commands would drag a robot along the ground
            self.requests.ask(Request.END)
        else:
            self.requests.forget()  # the new mission must not end
        self._select_here()
        self.outcome = self._report(code, waypoint, text, now_ns)

    @property
    def _onboard(self) -> int:
        """Number of waypoints of this mission that the robot has stored as reached."""
        seen = self.seen
        return seen.reached if seen and seen.mission_id == self._mission_id != 0 else 0

    @property
    def _drives(self) -> bool:
        """Whether the operator has moved the setpoint of the held mission by hand."""
        setpoint = self._setpoint
        return self.state == HELD and setpoint is not None and type(setpoint.motion) is Drive

    @property
    def _from_spawn(self) -> bool:
        return self._plan.start is Start.SPAWN and not self._continued

    @property
    def _may_move(self) -> bool:
        """Whether the robot must be reset to its spawn, and would still follow a setpoint now."""
        return self._from_spawn and not self.requests.waits

    def _select_early(self, now_ns: int) -> None:
        """Select the first waypoint before telemetry shows that the mission began, to save time.

        If the mission begins with a reset to the spawn, first wait until the robot ignores
        commands; otherwise the robot would fly to the waypoint before the reset.
        """
        if not self._is_pending or self.seen is None or self._may_move:
            return
        self._is_pending = False
        leg = 0 if self._from_spawn else max(self.leg, self._onboard)
        if leg < len(self._plan.legs):
            self._select_leg(leg, now_ns)

    def _repeat_setpoint(self, now_ns: int) -> None:
        """Send the setpoint again, because a new session has begun.

        Send the robot's position instead if the operator steers by hand, or if the mission still
        has to reset the robot to the spawn.
        """
        if self.state == STARTING and self._may_move:
            self._is_pending = True
            self._select_here()
        elif self._drives:
            self._select_here()
        elif self._setpoint is not None and type(self._setpoint.motion) is Motion:
            self._select_leg(self._setpoint.waypoint, now_ns)
        elif self._setpoint is not None:
            self._select(self._setpoint)

    def _select_leg(self, leg: int, begin_ns: int, start: Vector | None = None) -> None:
        """Make waypoint `leg` the setpoint, or move the setpoint to it if the leg has a speed.

        The motion begins at the time `begin_ns` [ns], from the point `start` [m] or, by default,
        from the robot.
        """
        to, motion = self._plan.legs[leg], None
        if to.speed and self.seen is not None:
            motion = Motion(start or self.seen.position, begin_ns, to.speed, to.acceleration)
        if not self._stays:
            self._select(self._setpoint_of(to, leg)._replace(motion=motion))

    def _select_here(self) -> None:
        if self.seen is not None:
            x, y, z = self.seen.position
            z = max(z, self._fence.inner_low[2])  # lower, the robot would scrape along the ground
            self._select(self._setpoint_of(Leg((x, y, z)), NO_WAYPOINT))

    def _setpoint_of(self, leg: Leg, waypoint: int) -> Setpoint:
        """Return the setpoint at a leg; without a yaw, it keeps the yaw of the setpoint before."""
        if leg.yaw is not None:
            return Setpoint(leg.position, leg.yaw, waypoint, turns=True)
        yaw = 0.0 if self._setpoint is None else self._setpoint.yaw
        return Setpoint(leg.position, yaw, waypoint)

    def _select(self, setpoint: Setpoint) -> None:
        epoch = 0 if self.seen is None else self.seen.epoch
        self._setpoint = setpoint._replace(epoch=epoch)
        self.outputs.append(self._setpoint)

    def _report(self, code: str, waypoint: int, text: str, now_ns: int) -> MissionEvent:
        self.state = STATES.get(code, self.state)
        event = MissionEvent(now_ns, code, waypoint, text)
        self.outputs.append(event)
        return event

    @property
    def where(self) -> str:
        """Place in the mission, for an event's text, such as "on the way to waypoint 1 of 7"."""
        return f"on the way {'along the' if self._plan.track else 'to'} {self._leg_name}"

    @property
    def _leg_name(self) -> str:
        if self._plan.track:
            return "setpoints"
        return f"{self._plan.unit} {self.leg + 1} of {len(self._plan.legs)}"
