"""Safety invariants, checked after every 2 ms step, independently of the guard.

fence      The base stays inside the fence while the rotors turn. After an emergency stop or a hit
           the robot may leave the fence, but at most by `FALL_MAX`. Rotors that have stopped turn
           again only where the robot lies still inside.
cap, stop  The reference stays below the caps and can be stopped before the fence. In LAND the floor
           is no limit.
stale      No command with an older basis than the limit is accepted, nor flown in TRACK.
rest       After TRACK the robot stops within its stopping distance. The rotors stop only on a
           request, after a hit, or where the robot stands.
collision  With an honest cloud only the arm's tip touches anything, and only the board. A robot
           that lands, or that the operator stopped, may come down on anything: the guard does not
           know what is below.
tick       Each step of the physics has a tick of the guard.

`hold_invariants` has the other invariants: of the operator's requests and of the end of a HOLD. All
limits come from the configuration, none from the guard.
"""

from __future__ import annotations

from collections import Counter
from math import hypot, inf, sqrt
from typing import NamedTuple

from cloudrc.config.load import ResolvedGuard
from cloudrc.faults.hold_invariants import (
    ESTOP,
    HOLD,
    LAND,
    SLACK,
    TRACK,
    HoldInvariants,
    Note,
    OperatorInvariants,
    growth,
)
from cloudrc.geometry.fence import HIGH, LOW, inside
from cloudrc.messages import ZERO, Command, GuardState, OperatorRequest, Request, Start, Vector
from cloudrc.world.readings import Readings, RotorSpeeds
from cloudrc.world.robot import STEP_NS, Robot
from cloudrc.world.rotors import STOPPED

FLOWN = (TRACK, HOLD, LAND)
REPORTED = 5
"""Number of breaches of each kind that are kept."""
STILL = 0.12
"""Speed below which a robot lies still [m/s]: the guard's 0.1, plus one tick of free fall."""
STANDS = 0.2
"""Speed per axis up to which a robot stands when its rotors stop [m/s]."""
FALL = 1.0
"""Speed of descent of a robot that fell after its rotors stopped [m/s]. A drop from the guard's
0.02 m reaches 0.7."""
REST = 0.5
"""Length added to the stopping distance of a robot without commands [m]: it swings back. In 200
flights of the search, half of them with a hostile cloud, at most 0.20 was used."""
FALL_MAX = 1.5
"""Distance from the fence at which people are safe [m]. Source: docs/safety.md, "The guard"."""
BRAKE_NS = 200_000_000
"""Time in which a descent that the operator has acknowledged is stopped [ns].
Source: docs/reference/plant.md, "Stop rule"."""
REELS_NS = 1_000_000_000
"""Time after a hit in which the hit explains the robot's motion [ns]."""
THROWN_NS = 3_000_000_000
"""Time after a hit in which the robot may be thrown out of the fence [ns]."""


class Breach(NamedTuple):
    """An invariant that did not hold.

    Attributes:
        time: World's clock [s].
        kind: Name of the invariant: "fence".
        text: What happened.
    """

    time: float
    kind: str
    text: str


class Limits(NamedTuple):
    """Limits that the guard has to keep.

    Attributes:
        speed: Largest reference [m/s].
        acceleration: Largest growth of the reference [m/s^2].
        yaw_rate: Largest yaw rate [rad/s].
        age_ns: Largest age of a command's basis [ns].
        hold_ns: Time in a mission after which HOLD becomes LAND [ns].
    """

    speed: float = 6.0
    acceleration: float = 12.0
    yaw_rate: float = 1.0
    age_ns: int = 250_000_000
    hold_ns: int = 60_000_000_000

    @classmethod
    def of(cls, guard: ResolvedGuard) -> Limits:
        """Read the limits from an experiment's section `guard`."""
        return cls(
            guard.speed_max_mps,
            guard.acceleration_max_mps2,
            guard.yaw_rate_max_radps,
            round(guard.command_age_max_ms * 1e6),
            round(guard.hold_max_s * 1e9),
        )


class Watch:
    """Collects the breaches of all robots of a flight, which follow each other.

    Attributes:
        breaches: The first breaches of each kind.
        counts: Number of breaches, by kind.
        margin: Smallest distance of the base to the fence, the floor excepted [m].
        speed: Largest reference [m/s].
        landed_on: What the robot touched while it landed, the floor excepted.
    """

    def __init__(self, limits: Limits) -> None:
        self.limits = limits
        self.breaches: list[Breach] = []
        self.counts: Counter[str] = Counter()
        self.margin, self.speed = 9.0, 0.0
        self.landed_on: set[str] = set()

    def attach(self, robot: Robot, start_ns: int, *, honest: bool) -> None:
        """Check every step of a robot from now on.

        Args:
            robot: The robot.
            start_ns: Time of its first step [ns].
            honest: Whether its cloud is honest; then a hit is a breach.
        """
        robot.observers.append(RobotInvariants(robot, self, start_ns, honest))

    def note(self, now_ns: int, kind: str, text: str) -> None:
        """Note a breach at `now_ns` [ns]."""
        self.counts[kind] += 1
        if self.counts[kind] <= REPORTED:
            self.breaches.append(Breach(now_ns * 1e-9, kind, text))


class RobotInvariants:
    """Distributes what one robot does to the checks; an `Observer`."""

    def __init__(self, robot: Robot, watch: Watch, start_ns: int, honest: bool) -> None:
        limits = watch.limits
        self._robot, self._guard, self._note = robot, robot.guard, watch.note
        self._motion = MotionInvariants(robot, watch, honest)
        self._rotors = RotorInvariants(robot, watch.note, honest)
        self._operator = OperatorInvariants(watch.note)
        self._hold = HoldInvariants(watch.note, self._operator, limits.speed, limits.hold_ns)
        self._was = self._state = robot.guard.state  # after the last step; after the last event
        self._next_ns, self._steps = start_ns, 0

    def see_step(self, now_ns: int, readings: Readings, rotor_speeds: RotorSpeeds) -> None:
        """See `Observer`."""
        guard, steps = self._guard, self._robot.simulator.steps
        state, was = guard.state, self._was
        if now_ns != self._next_ns or steps != self._steps + 1:
            self._note(now_ns, "tick", "a step of the physics without a tick of the guard")
        self._next_ns, self._steps = now_ns + STEP_NS, steps
        reference = guard.reference
        if state is not was:
            self._operator.see_change(was, state, now_ns)
            self._hold.see_change(was, state, guard.cause, now_ns)
        if state is TRACK and not self._operator.armed:
            self._note(now_ns, "latch", "TRACK without the operator's start")
        self._hold.see_step(state, reference, now_ns)
        self._rotors.see_step(was, state, readings, rotor_speeds, now_ns)
        self._motion.see_step(was, state, readings, rotor_speeds, now_ns)
        self._was = self._state = state

    def see_command(self, command: Command, rejection: str | None, now_ns: int) -> None:
        """See `Observer`."""
        self._motion.see_command(command, rejection, now_ns)
        self._hold.see_command(command, rejection, self._state, now_ns)
        self._state = self._guard.state

    def see_request(self, request: OperatorRequest, now_ns: int) -> None:
        """See `Observer`."""
        resets = request.request is Request.START and request.start is Start.SPAWN
        if resets:
            self._steps = 0
        self._rotors.see_request(stops=resets or request.request is Request.ESTOP)
        if request.request is Request.ESTOP:
            self._motion.see_stop(self._state)
        self._hold.see_request(request, now_ns)
        self._operator.see_request(request, self._state)
        self._state = self._guard.state

    def see_session(self, now_ns: int) -> None:
        """See `Observer`."""
        self._hold.forget_commands()


class MotionInvariants:
    """Checks where the robot is, what it touches, and the reference that it flies."""

    def __init__(self, robot: Robot, watch: Watch, honest: bool) -> None:
        self._robot, self._guard, self._honest = robot, robot.guard, honest
        self._watch, self._note = watch, watch.note
        self._speed_max = watch.limits.speed + SLACK
        self._step_max = watch.limits.acceleration * STEP_NS * 1e-9 + SLACK
        self._comes_down = False  # whether it lands, or fell after an emergency stop
        self._falls = self._hit = False  # outside of flight: after a stop; after a hit
        self._basis_ns, self._before = -1, ZERO
        self._landed_ns = -2 * BRAKE_NS
        self._touches, self._seen = robot.simulator.touches, 0
        self._touched: tuple[int, str] | None = None
        self._is_thrown = False  # by a hit, and not yet back inside the fence
        self._left, self._way = ZERO, inf  # where TRACK ended, and how far the robot may go

    def see_command(self, command: Command, rejection: str | None, now_ns: int) -> None:
        """Check the age of an accepted command."""
        if rejection is None:
            age_ns = now_ns - command.basis_stamp_ns
            if not 0 <= age_ns <= self._watch.limits.age_ns:
                self._note(now_ns, "stale", f"accepted a command {age_ns * 1e-9:.3f} s old")
            self._basis_ns = max(self._basis_ns, command.basis_stamp_ns)

    def see_stop(self, state: GuardState) -> None:
        """Note an emergency stop in a state."""
        self._falls = self._falls or state in FLOWN
        self._comes_down = self._comes_down or self._falls

    def see_step(
        self,
        was: GuardState,
        state: GuardState,
        readings: Readings,
        rotor_speeds: RotorSpeeds,
        now_ns: int,
    ) -> None:
        """Check a step in `state`, after one in `was`."""
        position, reference, flies = readings.position, self._guard.reference, state in FLOWN
        self._hit = self._hit or (was in FLOWN and state is ESTOP and not self._falls)
        if flies and (self._falls or self._hit):
            self._falls = self._hit = False
            self._check_take_off(readings, now_ns)
        self._check_fence(position, now_ns)
        if was is TRACK and state is not TRACK:
            self._leave_track(readings, now_ns)
        if flies:
            self._comes_down = state is LAND
            self._check_stop(position, reference, state is LAND, now_ns)
            if not abs(self._guard.yaw_rate) <= self._watch.limits.yaw_rate:  # or it is NaN
                self._note(now_ns, "cap", f"reference turns by {self._guard.yaw_rate:.3f} rad/s")
            if reference is not self._before:
                self._check_caps(reference, state is TRACK, now_ns)
            if state is not TRACK:
                if any(rotor_speeds):
                    self._check_rest(position, now_ns)
            elif now_ns - self._basis_ns > self._watch.limits.age_ns:
                age = (now_ns - self._basis_ns) * 1e-9
                self._note(now_ns, "stale", f"TRACK on a command {age:.3f} s old")
        elif any(rotor_speeds):
            self._note(now_ns, "latch", f"rotors turn in {state.name}")
        if state is LAND:
            self._landed_ns = now_ns
        self._before = reference
        self._check_touches(state, now_ns)

    def _check_touches(self, state: GuardState, now_ns: int) -> None:
        """Check the contacts that began in this step.

        With a dishonest cloud, a contact only explains what follows.
        """
        touches = self._robot.simulator.touches
        if touches is not self._touches:
            self._touches, self._seen = touches, 0
        for body, tip, *_ in touches[self._seen :]:
            self._touched, self._way, self._is_thrown = (now_ns, body), inf, True
            # Acknowledged right above a pipe, a robot that lands cannot stop in time.
            lands = state is LAND or (state is HOLD and now_ns - self._landed_ns <= BRAKE_NS)
            low = lands or state not in FLOWN
            if not self._honest or (body == "board" and tip) or (low and body == "floor"):
                continue
            if low and (lands or self._comes_down):
                self._watch.landed_on.add(body)
            else:
                part = "tip" if tip else "body"
                self._note(now_ns, "collision", f"{part} touched {body} in {state.name}")
        self._seen = len(touches)

    def _leave_track(self, readings: Readings, now_ns: int) -> None:
        """From now on the robot may move only as far as it needs to stop."""
        speed = max(hypot(*readings.velocity), hypot(*self._before))
        self._left, self._way = readings.position, speed * (0.2 + speed / 6.0) + REST
        if self._touched is not None and now_ns - self._touched[0] < REELS_NS:
            self._way = inf

    def _check_rest(self, position: Vector, now_ns: int) -> None:
        dx, dy = position[0] - self._left[0], position[1] - self._left[1]
        if dx * dx + dy * dy > self._way * self._way:
            self._note(now_ns, "rest", f"{hypot(dx, dy):.2f} m from where the last command ended")

    def _check_take_off(self, readings: Readings, now_ns: int) -> None:
        speed = hypot(*readings.velocity)
        if speed > STILL or not inside(readings.position):
            x, y, z = readings.position
            text = f"base at ({x:.2f}, {y:.2f}, {z:.2f}) at {speed:.2f} m/s"
            self._note(now_ns, "fence", f"took off after a stop, {text}")

    def _check_fence(self, position: Vector, now_ns: int) -> None:
        watch, (x, y, z) = self._watch, position
        (xl, yl, zl), (xh, yh, zh) = LOW, HIGH
        margin = min(x - xl, xh - x, y - yl, yh - y, zh - z)
        if z < zl:
            self._note(now_ns, "fence", f"base at ({x:.2f}, {y:.2f}, {z:.2f}), below the floor")
        if self._is_thrown and margin >= 0.0 and self._touched is not None:
            self._is_thrown = now_ns - self._touched[0] < THROWN_NS
        if self._falls or self._hit or (self._is_thrown and margin < 0.0):
            if margin < -FALL_MAX:
                self._note(now_ns, "fence", f"base fell to ({x:.2f}, {y:.2f}, {z:.2f})")
        elif margin < watch.margin:
            watch.margin = margin
            if margin < 0.0:
                text = f"base at ({x:.2f}, {y:.2f}, {z:.2f})"
                if self._touched is not None:
                    since = (now_ns - self._touched[0]) * 1e-9
                    text += f", {since:.2f} s after it hit {self._touched[1]}"
                self._note(now_ns, "fence", text)

    def _check_stop(self, position: Vector, reference: Vector, lands: bool, now_ns: int) -> None:
        (x, y, z), (vx, vy, vz) = position, reference
        (xl, yl, zl), (xh, yh, zh) = LOW, HIGH
        if not (
            can_stop(vx, x - xl, xh - x)
            and can_stop(vy, y - yl, yh - y)
            and (can_stop(vz, z - zl, zh - z) or (lands and vz < 0.0))
        ):
            text = f"({vx:.3f}, {vy:.3f}, {vz:.3f}) m/s at ({x:.2f}, {y:.2f}, {z:.2f})"
            self._note(now_ns, "stop", f"reference {text}")

    def _check_caps(self, reference: Vector, ramped: bool, now_ns: int) -> None:
        vx, vy, vz = reference
        speed = sqrt(vx * vx + vy * vy + vz * vz)
        if speed > self._watch.speed:
            self._watch.speed = speed
        if not speed <= self._speed_max:  # or it is NaN
            self._note(now_ns, "cap", f"reference {speed:.3f} m/s")
        # Braking may be as hard as needed: at the fence, or after a hit.
        grown = growth(self._before, reference)
        if ramped and not grown <= self._step_max:
            self._note(now_ns, "cap", f"reference grows by {grown:.9f} m/s in a tick")


class RotorInvariants:
    """Checks how the rotors stop: on a request, after a hit, or where the robot stands.

    Stopped rotors are recognised by the constant that the robot gives to the simulator: hard
    braking also commands speeds of 0.
    """

    def __init__(self, robot: Robot, note: Note, honest: bool) -> None:
        self._simulator, self._note, self._honest = robot.simulator, note, honest
        self._turned = self._halted = self._is_asked = False

    def see_request(self, *, stops: bool) -> None:
        """Note a request, which may stop the rotors."""
        self._is_asked = self._is_asked or stops

    def see_step(
        self,
        was: GuardState,
        state: GuardState,
        readings: Readings,
        rotor_speeds: RotorSpeeds,
        now_ns: int,
    ) -> None:
        """Check a step in `state`, after one in `was`."""
        turns, asked = rotor_speeds is not STOPPED, self._is_asked
        if state is ESTOP and was is not ESTOP and self._honest and not (asked or self._touches):
            self._note(now_ns, "collision", "stopped by a hit although nothing was touched")
        if self._turned and not turns:
            self._halted = not asked and state is not ESTOP
            fastest = max(map(abs, readings.velocity))
            if self._halted and not fastest <= STANDS:
                self._note(now_ns, "rest", f"rotors stopped in {state.name} at {fastest:.2f} m/s")
        elif self._halted:
            self._halted = not turns and not asked
            if self._halted and readings.velocity[2] < -FALL and not self._touches:
                self._note(now_ns, "rest", f"falls in {state.name}, its rotors stopped in the air")
                self._halted = False
        self._turned, self._is_asked = turns, False

    @property
    def _touches(self) -> bool:
        """Whether the robot touches something, or just has."""
        return self._simulator.touch_age <= REELS_NS * 1e-9


def can_stop(speed: float, below: float, above: float) -> bool:
    """Tell whether the robot can stop before the face of the fence that it flies towards.

    Source: docs/reference/plant.md, "Stop rule": 0.2 v + v^2/6 <= distance - 0.1.

    Args:
        speed: Component of the velocity along an axis [m/s].
        below: Distance to the face at the axis' lower end [m].
        above: Distance to the face at the axis' upper end [m].
    """
    if speed > 0.0:
        return speed * (0.2 + speed / 6.0) <= above - 0.1 + SLACK
    return speed == 0.0 or speed * (speed / 6.0 - 0.2) <= below - 0.1 + SLACK
