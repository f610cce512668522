"""Brake, hold a position, land and take off with the onboard sensors alone.

Braking starts hard and ends gently, because the low-level controller follows late and overshoots.
The robot always brakes harder than the stop rule assumes (deceleration BRAKE after time REACTION).
"""

from __future__ import annotations

from math import hypot, nan
from operator import le

from cloudrc.messages import ZERO, Cause, Vector
from cloudrc.world.guard.limits import BRAKE, clamp, limit_length, step_towards
from cloudrc.world.readings import Readings

BRAKE_MAX, BRAKE_MIN = 5.5, 1.0
"""Largest and smallest deceleration of the reference [m/s^2]; the stop rule assumes 3 m/s^2."""
BRAKE_TIME_CONSTANT = 0.25
"""Time constant of the exponential end of braking [s]."""
BRAKE_LEAD, BRAKE_SHARE_MIN = 1.0, 0.2
"""When braking starts, the reference is BRAKE_LEAD [m/s] below the robot's speed, but not below
BRAKE_SHARE_MIN times that speed."""
STILL_SPEED = 0.1
"""Speed below which the robot counts as at rest [m/s]."""
LAND_SPEED = 0.5
"""Speed of the descent [m/s]. Source: docs/reference/plant.md, "Landing"."""
STILL_SHARE = 0.2
"""A descent has stopped when its speed is below this share of the planned speed: with a low
speed cap every descent is slower than STILL_SPEED."""
TOUCH_DOWN_NS = 400_000_000
"""Time without motion after which a descent has touched down [ns]."""
STILL_TICKS = 200
"""Number of ticks at rest after which the robot lies still: 0.4 s. A robot that was thrown up is
also at rest at its highest point, but for less time."""
POSITION_GAIN = 0.8
"""Gain of the position hold: velocity towards the hold point per distance from that point [1/s]."""
DAMPING_GAIN = 1.6
"""Damping of the position hold: share of the robot's velocity that is subtracted."""
HOLD_SPEED_MAX = 0.5
"""Largest speed that the position hold asks for [m/s]."""
INTEGRAL_GAIN, INTEGRAL_MAX, INTEGRAL_RANGE = 0.2, 0.05, 0.1
"""Position hold: integral gain [1/s^2], largest integral term per axis [m/s], and largest distance
from the hold point at which it integrates [m]. Without it the lopsided robot would stand 30 mm off
the hold point."""
TAKE_OFF_MARGIN = 0.5
"""Smallest distance from the fence's walls at which a stopped robot may take off [m]. A tilted
robot scrapes along the floor before it rises, by at most 0.35 m:
`pytest -m "" -k scrapes tests/world`."""
LIFT_OFF_HEIGHT, GROUND_SPEED_MAX = 0.02, 0.2
"""The robot has left the ground once its height has changed by LIFT_OFF_HEIGHT [m]. If the change
is smaller and the robot is slower than GROUND_SPEED_MAX [m/s], the rotors may stop: the robot then
falls from a small height, at low speed."""


class PositionHold:
    """Brakes the robot (`brakes`), holds it where it came to rest, or lets it descend there."""

    def __init__(self, low: Vector, high: Vector, speed_max: float) -> None:
        """Hold between `low` and `high` [m], world frame, no faster than `speed_max` [m/s]."""
        self._low, self._high = low, high
        self._speed_max = min(HOLD_SPEED_MAX, speed_max)
        self._hold_point: Vector | None = None
        self._integral = ZERO
        self.brakes = False

    def forget(self) -> None:
        """Forget the hold point, because the robot flies on."""
        self._hold_point, self.brakes = None, False

    def follow(self, reference: Vector, readings: Readings, sink: float, dt: float) -> Vector:
        """Return the next reference for braking, holding or descending [m/s], world frame.

        `reference` is the reference of the last tick, `dt` [s] ago, shape (3,). `sink` is the speed
        of the descent [m/s]; with 0 the robot keeps its height above the ground.
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
        return step_towards(reference, (x, y, z - sink), BRAKE * dt)

    def _brake(self, reference: Vector, readings: Readings, sink: float, dt: float) -> Vector:
        """Slow the reference down. Set the hold point once the robot is at rest."""
        if not self.brakes:
            reference, self.brakes = brake_start(reference, readings.velocity), True
        x, y, z = reference
        rest = (0.0, 0.0, -sink)
        reference = step_towards(reference, rest, brake_rate(hypot(x, y, z + sink)) * dt)
        vx, vy, vz = readings.velocity
        if reference is rest and hypot(vx, vy, vz + sink) < STILL_SPEED:
            x, y, z = map(clamp, readings.position, self._low, self._high)
            self._hold_point, self._integral, self.brakes = (x, y, z), ZERO, False
        return reference


def brake_start(reference: Vector, velocity: Vector) -> Vector:
    """Return the reference for the start of braking [m/s], which is slower than the robot.

    The robot follows late: if the reference were faster, it would first speed up. `reference` is
    the finite reference of the last tick, `velocity` is that of the robot; both are in [m/s], world
    frame, shape (3,).
    """
    start = velocity if hypot(*velocity) < hypot(*reference) else reference
    speed = hypot(*start)
    if speed == 0.0:
        return start
    share = max(BRAKE_SHARE_MIN, 1.0 - BRAKE_LEAD / speed)
    x, y, z = start
    return (share * x, share * y, share * z)


def brake_rate(speed: float) -> float:
    """Return the deceleration at which to brake from `speed` [m/s]: hard first, gentle last."""
    return min(BRAKE_MAX, max(BRAKE_MIN, speed / BRAKE_TIME_CONSTANT))


class Descent:
    """Detects touch-down, and whether a descent may still stop in the air.

    After an acknowledgement a descent stops in the air only if the robot sinks freely and is high
    enough. A robot that stops lower, or while it touches something, would scrape along the ground
    or a pipe.

    Attributes:
        speed: Speed of the descent [m/s].
        acknowledged: Whether the operator has acknowledged this landing.
    """

    def __init__(self, floor: float, speed_max: float) -> None:
        """Set `floor`, the lowest z of a hold point [m], and the speed cap `speed_max` [m/s]."""
        self._floor, self.speed = floor, min(LAND_SPEED, speed_max)
        self._still_speed = min(STILL_SPEED, STILL_SHARE * self.speed)
        self.begin(0)

    def begin(self, now_ns: int) -> None:
        """Begin a descent at `now_ns` [ns], without an acknowledgement."""
        self._moved_ns, self.acknowledged = now_ns, False

    def may_stop(self, readings: Readings) -> bool:
        """Tell whether the operator has acknowledged and the robot sinks freely and high enough."""
        free = readings.velocity[2] < -0.5 * self.speed and readings.position[2] > self._floor
        return self.acknowledged and free

    def is_over(self, now_ns: int, reference: Vector, readings: Readings) -> bool:
        """Note the motion of this tick at `now_ns` [ns]; tell whether the robot has touched down.

        `reference` is the reference of the last tick [m/s].
        """
        if reference[2] > -0.5 * self.speed or abs(readings.velocity[2]) >= self._still_speed:
            self._moved_ns = now_ns
        return now_ns - self._moved_ns >= TOUCH_DOWN_NS


class TakeOff:
    """Detects when the robot has left the ground (`over`), and whether it may take off.

    Before take-off a robot in HOLD would scrape along the floor, so the rotors stop instead. A
    robot whose rotors were stopped in the air may still fall, or lie outside the fence, when the
    operator acknowledges. It may take off once it lies still, TAKE_OFF_MARGIN inside the fence.
    """

    def __init__(self, low: Vector, high: Vector) -> None:
        """Set the corners of the fence, `low` and `high` [m]; the robot is on the ground."""
        (ax, ay, az), (bx, by, bz) = low, high
        self._low = (ax + TAKE_OFF_MARGIN, ay + TAKE_OFF_MARGIN, az)
        self._high = (bx - TAKE_OFF_MARGIN, by - TAKE_OFF_MARGIN, bz)
        self.over = self._stopped = False
        self._still_ticks, self._height = 0, nan

    @property
    def allowed(self) -> bool:
        """Whether the robot may leave the ground."""
        return not self._stopped or self._still_ticks >= STILL_TICKS

    @property
    def condition(self) -> Cause:
        """Cause of GROUND after an acknowledgement; STILL_FIRST if the robot must lie still."""
        return Cause.ACKNOWLEDGED if self.allowed else Cause.STILL_FIRST

    def forget(self, *, stopped: bool = False) -> None:
        """Reset to the state before take-off, because the robot stands or falls to the ground.

        `stopped`: the rotors may have been stopped in the air or on an obstacle.
        """
        self.over = False
        if stopped:
            self._stopped, self._still_ticks, self._height = True, 0, nan

    def look(self, readings: Readings, flies: bool) -> None:
        """Note where the robot stands or, while it `flies`, whether it has left the ground."""
        height = readings.position[2]
        if flies:
            self.over, self._stopped = not abs(height - self._height) < LIFT_OFF_HEIGHT, False
        else:
            self._height = height
            if self._stopped:
                at = readings.position
                inside = all(map(le, self._low, at)) and all(map(le, at, self._high))
                at_rest = inside and hypot(*readings.velocity) < STILL_SPEED
                self._still_ticks = self._still_ticks + 1 if at_rest else 0

    def may_end(self, readings: Readings) -> bool:
        """Tell whether the robot is still on the ground and slow enough to stop its rotors."""
        return not self.over and hypot(*readings.velocity) < GROUND_SPEED_MAX
