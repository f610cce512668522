"""Safety invariants, checked after every 2 ms step, independently of the guard.

fence      The robot's base stays inside the fence while the rotors turn. After a collision or an
           emergency stop the robot may leave the fence by at most `FALL_MAX`. Stopped rotors
           start again only if the robot is at rest inside the fence.
cap, stop  The velocity reference stays within its limits, and the robot can always stop before the
           fence. During LAND the robot may fly down to the floor. After a HOLD the reference
           velocity grows slowly at first.
stale      World rejects a command that is based on too old odometry. TRACK ends with the session,
           or when the last command's odometry is too old and the command's plan has ended. HOLD
           changes to TRACK only after `RESUME_COMMANDS` fresh commands within `RESUME_NS`.
rest       After TRACK the robot stops within its stopping distance. The rotors stop only on a
           request, after a collision, or if the robot does not move.
collision  If the cloud is honest, only the arm's tip touches something, and it touches only the
           board. A robot that lands, or that the operator has stopped, may touch anything, because
           the guard does not know what is below the robot.
latch      The robot is in TRACK only during a mission that the operator has started. LAND and ESTOP
           last until the operator acknowledges them.
hold       At least `SETTLE_NS` pass between two changes to TRACK. In a mission, a robot without
           commands lands after the configured time, or sooner after impossible commands.
order      Each applied command is newer than the last one, and not of an old session.
tick       The guard runs once in each step of the physics.

All limits come from the configuration and docs/, not from the guard: from "Stop rule" and "Leaving
HOLD" in reference/plant.md, F5 and F23 in reference/faults.md, and "The guard" in safety.md.
"""

from __future__ import annotations

from bisect import bisect_right
from collections import Counter, deque
from math import hypot, inf, sqrt
from typing import NamedTuple

from cloudrc.config.load import ResolvedGuard
from cloudrc.geometry.fence import HIGH, LOW, inside
from cloudrc.messages import (
    PLAN_STEP_NS,
    ZERO,
    Command,
    GuardState,
    OperatorRequest,
    Request,
    Start,
    Vector,
)
from cloudrc.records import CommandApplied, Record, SessionOpened
from cloudrc.world.onboard import Commands
from cloudrc.world.readings import Readings
from cloudrc.world.robot import STEP, STEP_NS, Robot

GROUND, TRACK, HOLD, LAND, ESTOP = GuardState
FLOWN, LATCHED = (TRACK, HOLD, LAND), (LAND, ESTOP)
REPORTED = 5  # number of breaches of each kind that are kept
SLACK = 1e-9  # tolerance for rounding [m/s]
STILL = 0.12
"""Largest speed of a robot at rest [m/s]: the guard's limit, 0.1, plus one step of free fall."""
STANDS = 0.2  # speed per axis up to which a robot stands when its rotors stop [m/s]
FALL = 1.0
"""Downward speed that proves a fall with stopped rotors [m/s]; a drop of 2 cm ends at only 0.7."""
REST = 0.5
"""Tolerance of the stopping distance after TRACK [m]; it includes a swing of up to 0.2 m."""
FALL_MAX = 1.5  # largest distance that a falling robot may leave the fence [m]
BRAKE_NS = 200_000_000  # time to stop a descent that the operator has acknowledged [ns]
REELS_NS = 1_000_000_000  # time after a collision in which it explains the robot's motion [ns]
THROWN_NS = 3_000_000_000  # time after a collision in which the robot may leave the fence [ns]
RESUME_COMMANDS, RESUME_NS = 10, 500_000_000
"""Number of fresh commands that end a HOLD, and the time within which they must arrive [ns]."""
SETTLE_NS = 1_000_000_000  # shortest time between two changes to TRACK [ns]
INVALID_COMMANDS, INVALID_NS = 5, 1_000_000_000
"""Number of impossible commands that cause a landing, if they arrive within INVALID_NS [ns]."""
INVALID = ("range", "future")  # reasons for which the guard rejects impossible commands
GROUND_NS = 10_000_000_000
"""Shortest time that a robot on the ground waits for a mission's first command [ns]."""
RAMP = 3.0  # largest growth of the reference after a HOLD [m/s^2]
RAMP_MIN = 1.0
"""Time of slow growth of the velocity reference after a HOLD [s], if the limit is below 3 m/s."""


class Breach(NamedTuple):
    """A violation of an invariant: the invariant's name, and what happened."""

    time: float  # time on world's clock [s]
    kind: str
    text: str


class Watch:
    """Collects the breaches of invariants in a flight, and checks the order of commands."""

    def __init__(self, limits: ResolvedGuard) -> None:
        self.limits = limits
        self.breaches: list[Breach] = []  # the first ones of each kind
        self.counts: Counter[str] = Counter()  # of breaches, by kind
        self.margin = 9.0  # smallest distance of the base to the fence, without the floor [m]
        self.speed = 0.0  # largest reference [m/s]
        self.starts_ns: list[int] = []  # when world's processes began [ns]
        self._newest = (0, 0, -1)  # newest command: process of world, epoch and counter

    def attach(self, robot: Robot, start_ns: int, *, honest: bool) -> None:
        """Check a robot from `start_ns` [ns] on; check its contacts only if cloud is `honest`."""
        robot.observers.append(RobotInvariants(robot, self, start_ns, honest))
        self.starts_ns.append(start_ns)

    def see(self, records: list[Record], now_ns: int) -> None:
        """Check in the new `records` of world that each command was applied once and in order.

        The order of commands is that of epochs and, within an epoch, of counters. It begins anew
        with each process of world: if cloud knows no epoch, a restarted world begins at the first.
        """
        for record in records:
            if isinstance(record, CommandApplied | SessionOpened):
                counter = record.counter if isinstance(record, CommandApplied) else -1
                process = bisect_right(self.starts_ns, record.stamp_ns)
                if (this := (process, record.epoch, counter)) <= self._newest:
                    text = f"command {counter} of epoch {record.epoch} after {self._newest[1:]}"
                    self.note(record.stamp_ns, "order", text)
                self._newest = max(self._newest, this)

    def note(self, now_ns: int, kind: str, text: str) -> None:
        """Record a breach of the invariant `kind` at `now_ns` [ns]; `text` describes it."""
        self.counts[kind] += 1
        if self.counts[kind] <= REPORTED:
            self.breaches.append(Breach(now_ns * 1e-9, kind, text))


class RobotInvariants:
    """Checks one robot after every step of its physics; an `Observer`."""

    def __init__(self, robot: Robot, watch: Watch, start_ns: int, honest: bool) -> None:
        self._guard, self._simulator, self._honest = robot.guard, robot.simulator, honest
        self._stopped = robot.onboard.stopped
        self._watch, self._note, self._limits = watch, watch.note, watch.limits
        self._age_ns = round(watch.limits.command_age_max_ms * 1e6)
        self._plan_ns = round(watch.limits.plan_max_s * 1e9)
        self._hold_ns = round(watch.limits.hold_max_s * 1e9)
        self._was = self._state = robot.guard.state  # after the last step; after the last event
        self._next_ns, self._steps = start_ns, 0
        self._before = ZERO  # the last reference [m/s]
        self._fresh_until_ns = -1  # when the last accepted command gets too old [ns]
        # Motion after a stop or a collision, and after TRACK.
        self._comes_down = False  # whether it lands, or fell after an emergency stop
        self._falls = False  # after a stop or a collision, until it flies again
        self._landed_ns = -2 * BRAKE_NS
        self._left, self._way = ZERO, inf  # where TRACK ended, and how far the robot may go
        # Contacts and rotors.
        self._touches, self._seen = robot.simulator.touches, 0
        self._touched_ns = -THROWN_NS
        self._is_thrown = False  # by a collision, and not yet back inside the fence
        self._turned = self._halted = self._is_asked = False
        # The operator, and the wait for commands.
        self._ramp_ns = round(max(RAMP_MIN, watch.limits.speed_max_mps / RAMP) * 1e9)
        self._ramp_until_ns, self._alone_ns = -1, 0
        self._tracked_ns = -SETTLE_NS
        self._armed = False  # whether a mission is on
        self._released = set[GuardState]()  # states acknowledged since the last change
        self._is_reset = self._impossible = False
        self._fresh_ns: deque[int] = deque(maxlen=RESUME_COMMANDS)
        self._invalid_ns: deque[int] = deque(maxlen=INVALID_COMMANDS)

    # Calls of the robot.

    def see_step(self, now_ns: int, readings: Readings, commands: Commands) -> None:
        """Implement `Observer.see_step`: check all invariants."""
        steps, was, state = self._simulator.steps, self._was, self._guard.state
        if now_ns != self._next_ns or steps != self._steps + 1:
            self._note(now_ns, "tick", "a step of the physics without a tick of the guard")
        self._next_ns, self._steps = now_ns + STEP_NS, steps
        if state is not was:
            self._check_change(was, state, now_ns)
        self._check_wait(state, now_ns)
        self._check_rotors(state, readings.velocity, commands, now_ns)
        self._check_fence(state, readings.position, readings.velocity, now_ns)
        if was is TRACK and state is not TRACK:
            self._leave_track(readings, now_ns)
        if state in FLOWN:
            self._check_flight(state, readings.position, any(commands), now_ns)
        elif any(commands):
            self._note(now_ns, "latch", f"rotors turn in {state.name}")
        if state is LAND:
            self._landed_ns = now_ns
        self._check_touches(state, now_ns)
        self._was, self._state, self._before = state, state, self._guard.reference

    def see_command(self, command: Command, rejection: str | None, now_ns: int) -> None:
        """Implement `Observer.see_command`: check an accepted command's age, count invalid ones."""
        if rejection is None:
            basis_ns = command.basis_stamp_ns
            if not 0 <= now_ns - basis_ns <= self._age_ns:
                age = (now_ns - basis_ns) * 1e-9
                self._note(now_ns, "stale", f"accepted a command {age:.3f} s old")
            self._fresh_until_ns = basis_ns + self._age_ns
            if command.plan:
                end_ns = command.planned_ns + (len(command.plan) + 1) * PLAN_STEP_NS
                end_ns = min(end_ns, now_ns + self._plan_ns)
                self._fresh_until_ns = max(self._fresh_until_ns, end_ns)
            if self._armed:
                if self._state is HOLD:
                    self._fresh_ns.append(now_ns)
                elif self._state is GROUND:
                    self._alone_ns = now_ns
        elif rejection in INVALID:
            self._invalid_ns.append(now_ns)
            took_ns = now_ns - self._invalid_ns[0]
            if len(self._invalid_ns) == INVALID_COMMANDS and took_ns <= INVALID_NS:
                self._impossible = True
        self._state = self._guard.state

    def see_request(self, request: OperatorRequest, now_ns: int) -> None:
        """Implement `Observer.see_request`: store what the request allows the robot to do."""
        match request.request:
            case Request.START:
                if request.start is Start.SPAWN:
                    self._steps, self._is_asked = 0, True
                    self._tracked_ns = -SETTLE_NS
                    self._is_reset, self._ramp_until_ns = True, -1
                if request.start is Start.SPAWN or not self._armed:
                    self.see_session(now_ns)
                    self._alone_ns = now_ns
                self._armed = True
            case Request.ESTOP:
                self._armed, self._is_asked = False, True
                self._falls = self._falls or self._state in FLOWN
                self._comes_down = self._comes_down or self._state in FLOWN
            case Request.END:
                self._armed = False
            case Request.ACKNOWLEDGE:
                self._released.add(self._state)
        self._state = self._guard.state

    def see_session(self, now_ns: int) -> None:
        """Implement `Observer.see_session`: forget the commands of the old session."""
        self._fresh_until_ns = -1
        self._fresh_ns.clear()
        self._invalid_ns.clear()

    # Position and velocity reference.

    def _check_flight(self, state: GuardState, position: Vector, turns: bool, now_ns: int) -> None:
        """Check the reference in TRACK, HOLD or LAND; `turns` tells whether the rotors turn."""
        guard, reference = self._guard, self._guard.reference
        self._comes_down = state is LAND
        self._check_stop(position, reference, state is LAND, now_ns)
        if not abs(guard.yaw_rate) <= self._limits.yaw_rate_max_radps:  # or it is NaN
            self._note(now_ns, "cap", f"reference turns by {guard.yaw_rate:.3f} rad/s")
        if reference is not self._before:
            self._check_caps(reference, state is TRACK, now_ns)
        if state is TRACK:
            late = (now_ns - self._fresh_until_ns) * 1e-9
            if late > 0.0:
                self._note(now_ns, "stale", f"TRACK, {late:.3f} s after the last fresh command")
        elif turns:
            self._check_rest(position, now_ns)

    def _check_fence(
        self, state: GuardState, position: Vector, velocity: Vector, now_ns: int
    ) -> None:
        """Check that the base is inside the fence, or near it in a fall or after a collision.

        After an ESTOP in the air, the next take-off must begin at rest and inside the fence.
        """
        self._falls = self._falls or (self._was in FLOWN and state is ESTOP)
        if self._falls and state in FLOWN:
            self._falls, speed = False, hypot(*velocity)
            if speed > STILL or not inside(position):
                text = f"took off after a stop, base at {_show(position)} at {speed:.2f} m/s"
                self._note(now_ns, "fence", text)
        watch, (x, y, z) = self._watch, position
        (xl, yl, zl), (xh, yh, zh) = LOW, HIGH
        margin = min(x - xl, xh - x, y - yl, yh - y, zh - z)
        if z < zl:
            self._note(now_ns, "fence", f"base at {_show(position)}, below the floor")
        if self._is_thrown and margin >= 0.0:
            self._is_thrown = now_ns - self._touched_ns < THROWN_NS
        if self._falls or (self._is_thrown and margin < 0.0):
            if margin < -FALL_MAX:
                self._note(now_ns, "fence", f"base fell to {_show(position)}")
        elif margin < watch.margin:
            watch.margin = margin
            if margin < 0.0:
                self._note(now_ns, "fence", f"base at {_show(position)}")

    def _check_stop(self, position: Vector, reference: Vector, lands: bool, now_ns: int) -> None:
        (x, y, z), (vx, vy, vz) = position, reference
        (xl, yl, zl), (xh, yh, zh) = LOW, HIGH
        if not (
            can_stop(vx, x - xl, xh - x)
            and can_stop(vy, y - yl, yh - y)
            and (can_stop(vz, z - zl, zh - z) or (lands and vz < 0.0))
        ):
            text = f"reference ({vx:.3f}, {vy:.3f}, {vz:.3f}) m/s at {_show(position)}"
            self._note(now_ns, "stop", text)

    def _check_caps(self, reference: Vector, ramped: bool, now_ns: int) -> None:
        vx, vy, vz = reference
        speed = sqrt(vx * vx + vy * vy + vz * vz)
        if speed > self._watch.speed:
            self._watch.speed = speed
        if not speed <= self._limits.speed_max_mps + SLACK:  # or it is NaN
            self._note(now_ns, "cap", f"reference {speed:.3f} m/s")
        if ramped:  # braking is not limited: at the fence, or after a collision
            grown, after = growth(self._before, reference), now_ns < self._ramp_until_ns
            if not grown <= (RAMP if after else self._limits.acceleration_max_mps2) * STEP + SLACK:
                text = f"reference grows by {grown:.9f} m/s in a tick"
                self._note(now_ns, "cap", f"{text}{' after a HOLD' if after else ''}")

    def _leave_track(self, readings: Readings, now_ns: int) -> None:
        """Store where the robot was at the end of TRACK, and how far it may move from there."""
        speed = max(hypot(*readings.velocity), hypot(*self._before))
        self._left, self._way = readings.position, speed * (0.2 + speed / 6.0) + REST
        if now_ns - self._touched_ns < REELS_NS:
            self._way = inf

    def _check_rest(self, position: Vector, now_ns: int) -> None:
        dx, dy = position[0] - self._left[0], position[1] - self._left[1]
        if dx * dx + dy * dy > self._way * self._way:
            self._note(now_ns, "rest", f"{hypot(dx, dy):.2f} m from where the last command ended")

    # Contacts and stops of the rotors.

    def _check_touches(self, state: GuardState, now_ns: int) -> None:
        """Check that new contacts are allowed; a contact may push the robot out of the fence."""
        touches = self._simulator.touches
        if touches is not self._touches:
            self._touches, self._seen = touches, 0
        for _, body, _, _, _, tip in touches[self._seen :]:
            self._touched_ns, self._way, self._is_thrown = now_ns, inf, True
            # A landing that is acknowledged just above a pipe cannot stop in time.
            lands = state is LAND or (state is HOLD and now_ns - self._landed_ns <= BRAKE_NS)
            low = lands or state not in FLOWN
            allowed = (body == "board" and tip) or (
                low and (lands or self._comes_down or body == "floor")
            )
            if self._honest and not allowed:
                part = "tip" if tip else "body"
                self._note(now_ns, "collision", f"{part} touched {body} in {state.name}")
        self._seen = len(touches)

    def _check_rotors(
        self, state: GuardState, velocity: Vector, commands: Commands, now_ns: int
    ) -> None:
        """Check that the rotors stop only on a request, after a collision, or without motion.

        Hard braking also commands rotor speeds of 0. Therefore the check looks for the object
        `Onboard.stopped` itself, which is commanded only to stop the rotors.
        """
        turns, asked = commands is not self._stopped, self._is_asked
        is_hit = state is ESTOP and self._was is not ESTOP and not asked
        if is_hit and self._honest and not self._just_touched:
            self._note(now_ns, "collision", "stopped by a hit although nothing was touched")
        if self._turned and not turns:
            self._halted = not asked and state is not ESTOP
            fastest = max(map(abs, velocity))
            if self._halted and not fastest <= STANDS:
                self._note(now_ns, "rest", f"rotors stopped in {state.name} at {fastest:.2f} m/s")
        elif self._halted:
            self._halted = not turns and not asked
            if self._halted and velocity[2] < -FALL and not self._just_touched:
                self._note(now_ns, "rest", f"falls in {state.name}, its rotors stopped in the air")
                self._halted = False
        self._turned, self._is_asked = turns, False

    @property
    def _just_touched(self) -> bool:
        return self._simulator.touch_age <= REELS_NS * 1e-9

    # Requests of the operator, the wait for commands, and the end of HOLD.

    def _check_change(self, was: GuardState, state: GuardState, now_ns: int) -> None:
        if was in LATCHED and self._released.isdisjoint(LATCHED) and state is not ESTOP:
            self._note(now_ns, "latch", f"{was.name} left for {state.name} without the operator")
        self._released.intersection_update({state})
        self._armed = self._armed and state not in LATCHED
        self._ramp_until_ns = -1
        if state is TRACK:
            if now_ns - self._tracked_ns < SETTLE_NS:
                text = f"TRACK again after {(now_ns - self._tracked_ns) * 1e-9:.3f} s"
                self._note(now_ns, "hold", text)
            self._tracked_ns = now_ns
            if was is HOLD and not self._is_reset:
                self._ramp_until_ns = now_ns + self._ramp_ns
                fresh_ns = self._fresh_ns
                if len(fresh_ns) < RESUME_COMMANDS or fresh_ns[-1] - fresh_ns[0] > RESUME_NS:
                    text = f"HOLD left for TRACK on {len(fresh_ns)} fresh commands"
                    self._note(now_ns, "stale", text)
        elif state is HOLD or (was is TRACK and state is GROUND and not self._is_reset):
            # To GROUND: the robot had not left the ground yet.
            self._alone_ns = now_ns
        elif state is LAND and not self._impossible:
            alone_ns = now_ns - self._alone_ns
            if was is TRACK or alone_ns <= self._wait_ns(was):
                text = f"LAND out of {was.name} after {alone_ns * 1e-9:.3f} s alone"
                self._note(now_ns, "hold", text)
        if state is not HOLD:
            self._fresh_ns.clear()
        self._is_reset = self._impossible = False

    def _check_wait(self, state: GuardState, now_ns: int) -> None:
        if state is TRACK:
            if not self._armed:
                self._note(now_ns, "latch", "TRACK without the operator's start")
            return
        self._impossible = False
        alone_ns = now_ns - self._alone_ns
        if self._armed and alone_ns > self._wait_ns(state) + STEP_NS:
            self._note(now_ns, "hold", f"{state.name} for {alone_ns * 1e-9:.3f} s of a mission")
            self._alone_ns = now_ns

    def _wait_ns(self, state: GuardState) -> float:
        """Return how long the robot may stay in `state` without commands in a mission [ns]."""
        if state is GROUND:
            return max(self._hold_ns, GROUND_NS)
        return self._hold_ns if state is HOLD else inf


def can_stop(speed: float, below: float, above: float) -> bool:
    """Return whether the robot can stop before the side of the fence that it flies towards.

    `speed` is the velocity along one axis [m/s]. `below` and `above` are the robot's distances to
    the two sides of the fence on this axis [m].
    Source: docs/reference/plant.md, "Stop rule": 0.2 v + v^2/6 <= distance - 0.1.
    """
    if speed > 0.0:
        return speed * (0.2 + speed / 6.0) <= above - 0.1 + SLACK
    return speed == 0.0 or speed * (speed / 6.0 - 0.2) <= below - 0.1 + SLACK


def growth(before: Vector, after: Vector) -> float:
    """Return how much a velocity grows from `before` to `after` [m/s].

    This is the norm of the growth per axis: the increase of the speed, or 0 if the speed falls.
    If the direction on an axis reverses, all of the new speed is growth.
    """
    (ux, uy, uz), (vx, vy, vz) = before, after
    return sqrt(_grown(ux, vx) ** 2 + _grown(uy, vy) ** 2 + _grown(uz, vz) ** 2)


def _grown(before: float, after: float) -> float:
    if before * after < 0.0:
        return abs(after)
    return max(abs(after) - abs(before), 0.0)


def _show(position: Vector) -> str:
    return f"({', '.join(f'{each:.2f}' for each in position)})"
