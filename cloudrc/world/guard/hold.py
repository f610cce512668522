"""How the guard comes to rest, lands and takes off: readings in, a velocity reference out.

Position and velocity of the sensors on board are all that is used. Braking starts hard and ends
gently, because the low-level controller follows late and swings back; the promise that the stop
rule builds on, BRAKE after REACTION, is kept with room to spare.
"""

from __future__ import annotations

from math import hypot, nan
from operator import le

from cloudrc.messages import ZERO, Cause, Vector
from cloudrc.world.guard.limits import BRAKE, shortened, towards, within
from cloudrc.world.readings import Readings

HARDEST, GENTLEST = 5.5, 1.0
"""Range of what is flown in place of the 3 m/s^2 that are promised [m/s^2]."""
EASE = 0.25
"""In the end the reference falls exponentially, with this time constant [s]."""
LEAD, LEAST_SHARE = 1.0, 0.2
"""By so much [m/s] the reference begins ahead of the robot, but not below this share of it."""
STILL = 0.1
"""Slower than this the robot counts as come to rest [m/s]."""
LAND_SPEED = 0.5
"""Speed of the descent [m/s]. Source: docs/reference/plant.md, "Landing"."""
STILL_SHARE = 0.2
"""A descent slower than this share of its speed stands, where that is below STILL: with a low cap
every descent is slower than STILL, and would count as touched down in the air."""
TOUCH_DOWN_NS = 400_000_000
"""A descent that has stood still for so long has touched down [ns]."""
STILL_TICKS = 200
"""So many at rest, 0.4 s: what is thrown up stands still for less than that."""
PULL = 0.8
"""Of the position hold: velocity per distance [1/s]."""
DAMPING = 1.6
"""Of the position hold: velocity taken back per velocity [1]."""
PULL_MAX = 0.5
"""Of the position hold [m/s]."""
TRIM, TRIM_MAX, TRIM_REACH = 0.2, 0.05, 0.1
"""Likewise: velocity added per distance and time [1/s^2], at most so much per axis [m/s], and only
this near [m]: farther off the robot is on its way. What is lopsided needs more than the low-level
controller's integral gives: without this it would stand 30 mm nearer to a pipe than it stopped."""
TAKE_OFF_MARGIN = 0.5
"""So far from the walls [m] a robot that was stopped has to lie to take off: tilted, it scrapes
along the floor before it rises, by 0.35 m at most: `pytest -m "" -k scrapes tests/world`."""
HOP, HOP_SPEED = 0.02, 0.2
"""A robot that has not been this far [m] above or below where it stood stands there still, if it is
slower than this [m/s]: it drops from no higher, and hits nothing at speed."""


class Rest:
    """Brakes, holds the position where the robot came to rest, or goes down from there.

    Attributes:
        brakes: Whether the robot is coming to rest, and has no position to hold yet.
    """

    def __init__(self, low: Vector, high: Vector, speed_max: float) -> None:
        """Begin without a position.

        Args:
            low: Corner of where a position may be held [m], world frame, shape (3,).
            high: The opposite corner [m], shape (3,).
            speed_max: Of the position hold, if it is below PULL_MAX [m/s].
        """
        self._low, self._high = low, high
        self._pull_max = min(PULL_MAX, speed_max)
        self._anchor: Vector | None = None
        self._trim = ZERO
        self.brakes = False

    def forget(self) -> None:
        """The robot moves on; the next rest is another one."""
        self._anchor, self.brakes = None, False

    def follow(self, reference: Vector, readings: Readings, sink: float, dt: float) -> Vector:
        """Go on with braking, with holding the position, and with going down.

        Args:
            reference: As followed so far [m/s], world frame, shape (3,).
            readings: Of the sensors on board.
            sink: How fast to go down [m/s], 0 to stay.
            dt: Time since the last call [s].
        """
        if self._anchor is None:
            return self._brake(reference, readings, sink, dt)
        (ax, ay, az), (x, y, z), (vx, vy, vz) = self._anchor, readings.position, readings.velocity
        dx, dy, dz = ax - x, ay - y, 0.0 if sink else az - z
        tx, ty, tz = self._trim
        if hypot(dx, dy, dz) < TRIM_REACH:
            self._trim = self._trimmed((dx, dy, dz), dt)
        up = 0.0 if sink else PULL * dz - DAMPING * vz + tz
        back = (PULL * dx - DAMPING * vx + tx, PULL * dy - DAMPING * vy + ty, up)
        x, y, z = shortened(back, self._pull_max)
        return towards(reference, (x, y, z - sink), BRAKE * dt)

    def _trimmed(self, distance: Vector, dt: float) -> Vector:
        """Move the trim [m/s] on by `dt` [s] at this `distance` [m] from the anchor, shape (3,)."""
        (tx, ty, tz), (dx, dy, dz), gain = self._trim, distance, TRIM * dt
        return (
            within(tx + gain * dx, -TRIM_MAX, TRIM_MAX),
            within(ty + gain * dy, -TRIM_MAX, TRIM_MAX),
            within(tz + gain * dz, -TRIM_MAX, TRIM_MAX),
        )

    def _brake(self, reference: Vector, readings: Readings, sink: float, dt: float) -> Vector:
        """Slow down; at rest, drop anchor."""
        if not self.brakes:
            reference, self.brakes = brake_start(reference, readings.velocity), True
        x, y, z = reference
        rest = (0.0, 0.0, -sink)
        reference = towards(reference, rest, brake_rate(hypot(x, y, z + sink)) * dt)
        vx, vy, vz = readings.velocity
        if reference is rest and hypot(vx, vy, vz + sink) < STILL:
            x, y, z = map(within, readings.position, self._low, self._high)
            self._anchor, self._trim, self.brakes = (x, y, z), ZERO, False
        return reference


def brake_start(reference: Vector, velocity: Vector) -> Vector:
    """Say where the reference begins to brake: ahead of the robot, which follows it late.

    A robot that is slower than its reference would else go on speeding up for a while.

    Args:
        reference: So far, finite [m/s], shape (3,).
        velocity: Of the robot [m/s], world frame, shape (3,).
    """
    start = velocity if hypot(*velocity) < hypot(*reference) else reference
    speed = hypot(*start)
    if speed == 0.0:
        return start
    share = max(LEAST_SHARE, 1.0 - LEAD / speed)
    x, y, z = start
    return (share * x, share * y, share * z)


def brake_rate(speed: float) -> float:
    """Say how fast the reference falls at a `speed` [m/s]: hard first, gently in the end."""
    return min(HARDEST, max(GENTLEST, speed / EASE))


class Descent:
    """Tells a robot that has touched down from one that sinks, and may still stop in the air.

    What stands, or has not the room to come to rest in, would scrape along the ground, or into a
    pipe beside it: it goes on down, though it is acknowledged, and its rotors stop.

    Attributes:
        speed: Downwards [m/s].
        acknowledged: Whether the operator has seen it land.
    """

    def __init__(self, floor: float, speed_max: float) -> None:
        """Begin where nothing lands.

        Args:
            floor: Lowest height at which a position is held [m].
            speed_max: Of the descent, if it is below LAND_SPEED [m/s].
        """
        self._floor, self.speed = floor, min(LAND_SPEED, speed_max)
        self._still = min(STILL, STILL_SHARE * self.speed)
        self.begin(0)

    def begin(self, now_ns: int) -> None:
        """A descent begins at `now_ns` [ns], of which the operator does not know."""
        self._moved_ns, self.acknowledged = now_ns, False

    def may_stop(self, readings: Readings) -> bool:
        """Say whether the operator has called it off while it sinks freely, and high enough."""
        free = readings.velocity[2] < -0.5 * self.speed and readings.position[2] > self._floor
        return self.acknowledged and free

    def is_over(self, now_ns: int, reference: Vector, readings: Readings) -> bool:
        """Note whether the robot moves; say whether it stands on something.

        Args:
            now_ns: World's clock [ns].
            reference: As followed so far [m/s], world frame, shape (3,).
            readings: Of the sensors on board.
        """
        if reference[2] > -0.5 * self.speed or abs(readings.velocity[2]) >= self._still:
            self._moved_ns = now_ns
        return now_ns - self._moved_ns >= TOUCH_DOWN_NS


class TakeOff:
    """Tells a robot that has not left the ground yet from one that flies.

    Held in the air so near to the ground it would scrape along. One whose rotors were stopped may
    still be falling, or lie outside the fence, when it is acknowledged: it takes off while it is
    at rest, and that inside, by TAKE_OFF_MARGIN.

    Attributes:
        over: Whether the robot has left the ground.
    """

    def __init__(self, low: Vector, high: Vector) -> None:
        """Begin on the ground.

        Args:
            low: Corner of the fence [m], shape (3,).
            high: The opposite one [m], shape (3,).
        """
        (ax, ay, az), (bx, by, bz) = low, high
        self._low = (ax + TAKE_OFF_MARGIN, ay + TAKE_OFF_MARGIN, az)
        self._high = (bx - TAKE_OFF_MARGIN, by - TAKE_OFF_MARGIN, bz)
        self.over = self._stopped = False
        self._still, self._height = 0, nan

    @property
    def allowed(self) -> bool:
        """Whether it may leave the ground."""
        return not self._stopped or self._still >= STILL_TICKS

    @property
    def condition(self) -> Cause:
        """How it is acknowledged: whether something has yet to come before a take-off."""
        return Cause.ACKNOWLEDGED if self.allowed else Cause.STILL_FIRST

    def forget(self, *, stopped: bool = False) -> None:
        """The robot stands, or will; the next take-off is another one.

        Args:
            stopped: Whether its rotors were stopped elsewhere than on the ground, perhaps.
        """
        self.over = False
        if stopped:
            self._stopped, self._still, self._height = True, 0, nan

    def look(self, readings: Readings, flies: bool) -> None:
        """Note where the robot stands, or see whether it has left.

        Args:
            readings: Of the sensors on board.
            flies: Whether its rotors turn.
        """
        height = readings.position[2]
        if flies:
            self.over, self._stopped = not abs(height - self._height) < HOP, False
        else:
            self._height = height
            if self._stopped:
                self._count_rest(readings)

    def _count_rest(self, readings: Readings) -> None:
        low, position, high = self._low, readings.position, self._high
        inside = all(map(le, low, position)) and all(map(le, position, high))
        at_rest = inside and hypot(*readings.velocity) < STILL
        self._still = self._still + 1 if at_rest else 0

    def may_end(self, readings: Readings) -> bool:
        """Say whether the rotors may stop here."""
        return not self.over and hypot(*readings.velocity) < HOP_SPEED
