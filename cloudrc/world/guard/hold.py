# SPDX-License-Identifier: Apache-2.0

"""Brake, hold a position, land and take off with the onboard sensors alone.

The deceleration falls towards the end of braking. The robot follows the velocity reference with a
delay, so a constant deceleration would make the robot overshoot. The guard's stop rule computes a
stopping distance from the robot's braking (robot.yaml), which begins after the time REACTION. The
robot always stops within this distance.
"""

from __future__ import annotations

from math import hypot, inf, nan
from operator import le

from cloudrc.physics.geometry.fence import TAKE_OFF_MARGIN, Fence
from cloudrc.physics.geometry.vectors import step_towards
from cloudrc.physics.sim.readings import Readings
from cloudrc.wire.messages import ZERO, Cause, Vector
from cloudrc.world.guard.limits import clamp, limit_length

BRAKE_MAX, BRAKE_MIN, BRAKE = 5.5, 1.0, 3.0
"""Largest and smallest deceleration of the velocity reference while a robot with the braking BRAKE
brakes [m/s^2]; both are in proportion for other robots."""
BRAKE_TIME_CONSTANT = 0.25
"""Time constant with which the velocity reference decays to zero at the end of braking [s]."""
BRAKE_LEAD, BRAKE_SHARE_MIN = 1.0, 0.2
"""When braking begins, the velocity reference is the robot's speed minus BRAKE_LEAD [m/s], and at
least BRAKE_SHARE_MIN times the robot's speed."""
STILL_SPEED = 0.1
"""Speed below which the robot counts as at rest [m/s]."""
LAND_SPEED = 0.5
"""Speed of the descent [m/s]. Source: docs/safety.md, "States"."""
STILL_SHARE = 0.2
"""A descending robot counts as at rest if it is slower than STILL_SPEED, and slower than this share
of the planned speed. With a low speed cap, the planned speed itself may be below STILL_SPEED."""
TOUCH_DOWN_NS = 400_000_000
"""Time at rest after which a descending robot has touched down [ns]."""
STILL_TICKS = 200
"""Number of steps at rest after which the robot counts as lying on the ground (0.4 s). A robot that
was thrown up is also at rest at its highest point, but for less time."""
POSITION_GAIN = 0.8
"""Gain of the position hold [1/s]: velocity reference per distance from the hold point."""
DAMPING_GAIN = 1.6
"""Damping of the position hold [1]: it subtracts this factor times the robot's velocity."""
HOLD_SPEED_MAX = 0.5
"""Largest velocity reference of the position hold [m/s]."""
INTEGRAL_GAIN, INTEGRAL_MAX, INTEGRAL_RANGE = 0.2, 0.05, 0.1
"""Integral term of the position hold: gain [1/s^2], limit per axis [m/s], and largest distance from
the hold point at which the term changes [m]. The arm makes the robot heavier on one side; without
this term the robot would hover 30 mm away from the hold point."""
LIFT_OFF_HEIGHT, GROUND_SPEED_MAX = 0.02, 0.2
"""The robot has left the ground once its height has changed by LIFT_OFF_HEIGHT [m]. Before that,
the guard may switch the robot off if it is slower than GROUND_SPEED_MAX [m/s]."""


class PositionHold:
    """Compute velocity references to brake, to hold the position, and to descend.

    `brakes` tells whether the robot still brakes.
    """

    def __init__(self, low: Vector, high: Vector, speed_max: float, braking: float) -> None:
        """Set the box for hold points, and the limit `speed_max` of the reference [m/s].

        `low` and `high` are the corners of the box [m], world frame. `braking` is the deceleration
        of the robot [m/s^2].
        """
        self._low, self._high, self._braking = low, high, braking
        self._speed_max = min(HOLD_SPEED_MAX, speed_max)
        self._hold_point: Vector | None = None
        self._integral = ZERO
        self.brakes = False

    def forget(self) -> None:
        """Forget the hold point: the next call of `follow` begins to brake."""
        self._hold_point, self.brakes = None, False

    def follow(self, reference: Vector, readings: Readings, sink: float, dt: float) -> Vector:
        """Return the velocity reference for braking, holding or descending [m/s], world frame.

        `reference` is the velocity reference of the last step, `dt` [s] ago, shape (3,). `sink` is
        the speed of the descent [m/s]; with 0 the robot stays at the height of the hold point.
        """
        if self._hold_point is None:
            return self._brake(reference, readings, sink, dt)
        (hx, hy, hz), (x, y, z) = self._hold_point, readings.position
        vx, vy, vz = readings.velocity
        dx, dy, dz = hx - x, hy - y, 0.0 if sink else hz - z
        ix, iy, iz = self._integral
        if hypot(dx, dy, dz) < INTEGRAL_RANGE:
            gain, most = INTEGRAL_GAIN * dt, INTEGRAL_MAX
            x, y, z = ix + gain * dx, iy + gain * dy, iz + gain * dz
            self._integral = clamp(x, -most, most), clamp(y, -most, most), clamp(z, -most, most)
        back_x = POSITION_GAIN * dx - DAMPING_GAIN * vx + ix
        back_y = POSITION_GAIN * dy - DAMPING_GAIN * vy + iy
        back_z = 0.0 if sink else POSITION_GAIN * dz - DAMPING_GAIN * vz + iz
        x, y, z = limit_length((back_x, back_y, back_z), self._speed_max)
        return step_towards(reference, (x, y, z - sink), self._braking * dt)

    def _brake(self, reference: Vector, readings: Readings, sink: float, dt: float) -> Vector:
        """Brake for one step of `dt` [s]; at the velocity of the descent, set the hold point."""
        if not self.brakes:
            reference, self.brakes = brake_start(reference, readings.velocity), True
        x, y, z = reference
        rest = (0.0, 0.0, -sink)
        rate = brake_rate(hypot(x, y, z + sink), self._braking)
        reference = step_towards(reference, rest, rate * dt)
        vx, vy, vz = readings.velocity
        if reference is rest and hypot(vx, vy, vz + sink) < STILL_SPEED:
            x, y, z = map(clamp, readings.position, self._low, self._high)
            self._hold_point, self._integral, self.brakes = (x, y, z), ZERO, False
        return reference


def brake_start(reference: Vector, velocity: Vector) -> Vector:
    """Return the velocity reference when braking begins [m/s]: slower than the robot.

    With a reference at the robot's speed, the robot would first speed up, because it follows with a
    delay. `reference` is the reference of the last step and finite; `velocity` is the robot's
    velocity. Both are in [m/s], world frame, shape (3,).
    """
    start = velocity if hypot(*velocity) < hypot(*reference) else reference
    speed = hypot(*start)
    if speed == 0.0:
        return start
    share = max(BRAKE_SHARE_MIN, 1.0 - BRAKE_LEAD / speed)
    x, y, z = start
    return (share * x, share * y, share * z)


def brake_rate(speed: float, braking: float) -> float:
    """Return the deceleration [m/s^2] for braking from `speed` [m/s]: large at high speed.

    `braking` is the deceleration that the robot reaches at least [m/s^2].
    """
    share = braking / BRAKE
    return min(share * BRAKE_MAX, max(share * BRAKE_MIN, speed / BRAKE_TIME_CONSTANT))


class Descent:
    """Detects the touch-down of a descent, and decides whether the robot may stop in the air.

    After the operator's acknowledgement, the robot stops its descent and holds its position, if
    it sinks unhindered and is above the lowest z for a hold. Otherwise the robot descends to
    touch-down, because a hold would make it scrape along the ground or an obstacle.

    Attributes:
        speed: Planned speed of the descent [m/s].
        acknowledged: Whether the operator has acknowledged this landing.
    """

    def __init__(self, floor: float, speed_max: float) -> None:
        """Set `floor` [m], the lowest z for a position hold, and `speed_max` [m/s]."""
        self._floor, self.speed = floor, min(LAND_SPEED, speed_max)
        self._still_speed = min(STILL_SPEED, STILL_SHARE * self.speed)
        self.begin(0)

    def begin(self, now_ns: int) -> None:
        """Begin a descent at `now_ns` [ns] that the operator has not acknowledged yet."""
        self._moved_ns, self.acknowledged = now_ns, False

    def may_stop(self, readings: Readings) -> bool:
        """Return whether the robot may stop its descent in the air, and hold its position there.

        The operator must have acknowledged the landing. The robot must sink at more than half the
        planned speed, and be above the lowest height for a position hold.
        """
        free = readings.velocity[2] < -0.5 * self.speed and readings.position[2] > self._floor
        return self.acknowledged and free

    def is_over(self, now_ns: int, reference: Vector, readings: Readings) -> bool:
        """Return whether the robot has touched down; call in every step of a descent.

        `now_ns` is world's clock [ns]. `reference` is the velocity reference of the last step
        [m/s], world frame, shape (3,).
        """
        if reference[2] > -0.5 * self.speed or abs(readings.velocity[2]) >= self._still_speed:
            self._moved_ns = now_ns
        return now_ns - self._moved_ns >= TOUCH_DOWN_NS


class Halt(Descent):
    """Ends the landing of a robot that does not descend: it brakes and stops at rest."""

    def __init__(self) -> None:
        """Plan no descent."""
        super().__init__(-inf, 0.0)

    def may_stop(self, readings: Readings) -> bool:
        """Return False: the robot does not descend."""
        return False

    def is_over(self, now_ns: int, reference: Vector, readings: Readings) -> bool:
        """Return whether the robot is at rest at `now_ns` [ns], world's clock.

        `reference` is that of `Descent.is_over` [m/s].
        """
        if not hypot(*readings.velocity) < STILL_SPEED:
            self._moved_ns = now_ns
        return now_ns - self._moved_ns >= TOUCH_DOWN_NS


class TakeOff:
    """Detects the end of the take-off, and decides whether the robot may take off.

    `over` becomes True when the robot has left the ground. If it was switched off in the air, the
    robot may still fall, or be outside the fence, when the operator acknowledges the stop. Before
    the robot may take off again, it has to come to rest on the ground, at least TAKE_OFF_MARGIN
    inside the fence. A planar robot takes off, as it were, when it is allowed to move; it needs no
    margin.

    Attributes:
        over: Whether the robot has left the ground.
        height: Height at which the robot stood when it was off [m]; NaN before.
        lift_off: Change of the height with which it has left the ground [m].
    """

    def __init__(self, fence: Fence) -> None:
        """Set the fence; begin before the take-off."""
        (ax, ay, az), (bx, by, bz) = fence.low, fence.high
        margin, self.lift_off = TAKE_OFF_MARGIN, LIFT_OFF_HEIGHT
        if fence.ground is not None:
            margin, self.lift_off, az, bz = 0.0, 0.0, -inf, inf
        self._low = (ax + margin, ay + margin, az)
        self._high = (bx - margin, by - margin, bz)
        self.over = self._stopped = False
        self._still_ticks, self.height = 0, nan

    @property
    def allowed(self) -> bool:
        """Whether the robot may leave the ground."""
        return not self._stopped or self._still_ticks >= STILL_TICKS

    @property
    def allowed_at_once(self) -> bool:
        """Whether the robot may leave the ground without a rest before."""
        return not self._stopped

    @property
    def condition(self) -> Cause:
        """Why the guard is in GROUND after the operator's acknowledgement.

        The cause tells whether the robot must be at rest before it may take off.
        """
        return Cause.ACKNOWLEDGED if self.allowed else Cause.STILL_FIRST

    def forget(self, *, stopped: bool = False) -> None:
        """Reset to the state before take-off, because the robot is switched off.

        With `stopped`, the robot may be in the air or on an obstacle. Then it may take off only
        after it has come to rest on the ground.
        """
        self.over = False
        if stopped:
            self._stopped, self._still_ticks, self.height = True, 0, nan

    def stand(self, height: float) -> None:
        """Take over what `look` finds if a robot that is off stands at `height` [m]."""
        self.height = height

    def rise(self, *, is_over: bool) -> None:
        """Take over what `look` finds of a robot that is on; `is_over`: it has left the ground."""
        self.over, self._stopped = is_over, False

    def look(self, readings: Readings, flies: bool) -> None:
        """Process the sensor readings of a physics step; `flies` tells whether it is on.

        While it is on, update `over`: whether the robot has left the ground. While it is off,
        update the robot's height on the ground and its time at rest.
        """
        height = readings.position[2]
        if flies:
            self.over, self._stopped = not abs(height - self.height) < self.lift_off, False
        else:
            self.height = height
            if self._stopped:
                at = readings.position
                inside = all(map(le, self._low, at)) and all(map(le, at, self._high))
                at_rest = inside and hypot(*readings.velocity) < STILL_SPEED
                self._still_ticks = self._still_ticks + 1 if at_rest else 0

    def may_end(self, readings: Readings) -> bool:
        """Return whether the robot may switch off: it is slow, and has not left the ground."""
        return not self.over and hypot(*readings.velocity) < GROUND_SPEED_MAX
