"""What the guard allows: set on world's side only, checked once, never zero and never infinite.

A limit that is switched off is the fault that nobody sees, so there is no value that does it.

The guard's arithmetic: pure functions on floats, of which each answers to any numbers at all.

Whatever comes in, NaN and infinities included, a finite answer inside its bound goes out. So every
comparison is written so that NaN fails it. `tests/world/guard/test_proof.py` proves the scalar
ones for all 64-bit floats.
"""

from __future__ import annotations

from dataclasses import dataclass
from math import copysign, inf, isfinite, sqrt

from cloudrc.geometry.fence import FLOOR_MARGIN
from cloudrc.messages import ZERO, Vector

BRAKE = 3.0
"""Deceleration that the robot is sure to reach [m/s^2].
Source: docs/reference/plant.md, "Stop rule"."""
REACTION = 0.2
"""Time until it does [s]. Source: docs/reference/plant.md, "Stop rule"."""
STOPPING_DISTANCE = 8.7
"""Distance within which the robot stops from the speed cap [m].
Source: docs/reference/plant.md, "Speed cap"."""
SIXTH = 1.0 / (2.0 * BRAKE)
CAUTION, MARGIN = 0.6, 0.2
"""At the fence v has to keep CAUTION v + v^2/6 <= distance - MARGIN [s], [m]. At the floor with
FLOOR_MARGIN instead, and there REACTION is enough, since the robot climbs readily.
Deviation: docs/reference/plant.md, "Stop rule", has 0.2 s and 0.1 m. With these a hostile cloud
gets the robot 0.3 m beyond the fence, because the low-level controller follows late."""
FAR = 1e6
"""Farther than this [m] a face limits nothing."""
GLIMPSE, GLIMPSE_NS = 0.25, 10_000_000
"""The robot moves by less than this [m] in so long [ns]: it is never faster than 25 m/s."""
COME_BACK, COME_BACK_MAX = 1.0, 0.5
"""Beyond the margin the robot has to fly back: velocity per distance [1/s], at most [m/s]."""
ASIDE = 0.44
"""What the robot hits turns it aside: so much of its speed [1] may become speed towards a wall. Off
the board's edge at 2.7 m/s it goes on across at 1.2."""
TOP, OFF_TOP = 0.55, 0.6
"""From so high above the margin of the floor [m] it may roll off the top of a pipe: its fall, too,
becomes speed towards a wall. So much more of its own is counted per height [1/m], up to 1 m."""
SLIDE, TUMBLE = 0.4, 0.3
"""A hit stops the rotors: the robot falls, goes on along the floor for so long [s], and then lies
so much [m] farther. Few get beyond that: `pytest -m "" -k after_a_fall tests/world`."""
BOUNCE = 0.2
"""What goes straight on meets the floor spinning, and may leave it faster than it came, at 2.6 m/s
after 1.9: it goes on for so much longer [s]."""
LATE = 0.3
"""The robot follows a braking reference so late [s]."""
CREEP = 0.5
"""No faster than this [m/s], the robot may fly anywhere: it hits nothing hard."""
HEIGHT_MAX, GRAVITY = 5.0, 9.81
"""A fall from higher than this [m] counts as one from there. [m/s^2]"""
LOW, LOW_SPEED = 0.25, 1.0
"""Lower than this [m] the robot flies sideways no faster than this [m/s]."""
SINK_LAG = 0.5
"""The reference goes down ahead of the robot by at most this [m/s]: asked for more than gravity
gives, the low-level controller would turn the robot over, and then brake nothing."""
JUST_BELOW = 1.0 - 2.0**-45
"""Times this, a cap is not exceeded by what is rounded on the way to the reference."""


def stopping_distance(speed: float, reaction: float) -> float:
    """Give the way [m] from a `speed` [m/s] to rest: `reaction` [s], then braking at BRAKE."""
    return speed * (reaction + speed * SIXTH)


def within(value: float, low: float, high: float) -> float:
    """Give `value`, or the end nearest to it of what lies between `low` and `high`.

    `low` if it is not a number; all three are in one unit, [m], [m/s] or [rad/s].
    """
    if value >= high:
        return high
    return value if value > low else low


def approach(reach: float, caution: float = CAUTION) -> float:
    """Say how fast the robot may be told to fly towards a face of the fence.

    The largest v with t v + v^2/6 <= d is 2 d / (t + sqrt(t^2 + 2 d/3)): solved so that no
    difference cancels. Beyond the face v is negative: the robot has to come back.

    Args:
        reach: Distance to the face [m], margin taken off.
        caution: t of the formula [s].
    """
    if reach > FAR:
        return inf
    if reach > 0.0:
        return 2.0 * reach / (caution + sqrt(caution * caution + 4.0 * SIXTH * reach))
    return max(COME_BACK * reach, -COME_BACK_MAX) if reach < 0.0 else 0.0


def is_far(velocity: Vector, position: Vector, low: Vector, high: Vector) -> bool:
    """Say whether `fenced` leaves a velocity as it is, here and up to GLIMPSE from here.

    Args:
        velocity: [m/s], world frame, shape (3,).
        position: Of the base [m], world frame, shape (3,).
        low: Corner of the fence [m], margins taken off, shape (3,).
        high: The opposite corner [m], shape (3,).
    """
    (vx, vy, vz), (x, y, z), (ax, ay, az), (bx, by, bz) = velocity, position, low, high
    speed = sqrt(vx * vx + vy * vy + vz * vz)
    if speed > CREEP:
        aside, straight = thrown(speed, z + GLIMPSE - az)
        spare = MARGIN - TUMBLE - GLIMPSE
        dx = max(aside, abs(vx) * straight) - spare
        dy = max(aside, abs(vy) * straight) - spare
        if not (ax + dx <= x <= bx - dx and ay + dy <= y <= by - dy):
            return False
    if vx > 0.0:
        bx -= vx * (CAUTION + vx * SIXTH)
    else:
        ax -= vx * (CAUTION - vx * SIXTH)
    if vy > 0.0:
        by -= vy * (CAUTION + vy * SIXTH)
    else:
        ay -= vy * (CAUTION - vy * SIXTH)
    if vz > 0.0:
        bz -= vz * (CAUTION + vz * SIXTH)
    else:
        az -= vz * (REACTION - vz * SIXTH)
    return (
        ax + GLIMPSE <= x <= bx - GLIMPSE
        and ay + GLIMPSE <= y <= by - GLIMPSE
        and az + GLIMPSE <= z <= bz - GLIMPSE
    )


def fenced(velocity: Vector, position: Vector, low: Vector, high: Vector) -> Vector:
    """Slow a reference, axis by axis, until the robot can stop before the faces of the fence.

    Near the floor it is slowed sideways, too: a rotor that touches at speed turns the robot over.
    And near the walls in every direction: should it hit something there, it has to come to lie
    before them, though nothing steers it any more.

    Args:
        velocity: Finite [m/s], world frame, shape (3,).
        position: Of the base [m], world frame, shape (3,).
        low: Corner of the fence [m], margins taken off, shape (3,).
        high: The opposite corner [m], shape (3,).
    """
    (vx, vy, vz), (x, y, z), (ax, ay, az), (bx, by, bz) = velocity, position, low, high
    if not z >= az - FLOOR_MARGIN + LOW:
        vx, vy, _ = shortened((vx, vy, 0.0), LOW_SPEED)
    inside = (
        within(vx, -approach(x - ax), approach(bx - x)),
        within(vy, -approach(y - ay), approach(by - y)),
        # Whoever stands on the floor is not asked to take off.
        within(vz, min(0.0, -approach(z - az, REACTION)), approach(bz - z)),
    )
    return shortened(inside, max(hit_speed(inside, position, low, high), CREEP))


def hit_speed(velocity: Vector, position: Vector, low: Vector, high: Vector) -> float:
    """Say how fast [m/s] the robot may fly this way to come to lie before the walls after a hit.

    Args:
        velocity: Finite [m/s], world frame, shape (3,).
        position: Of the base [m], world frame, shape (3,).
        low: Corner of the fence [m], margins taken off, shape (3,).
        high: The opposite corner [m], shape (3,).
    """
    (vx, vy, vz), (x, y, z), (ax, ay, az), (bx, by, _) = velocity, position, low, high
    speed = sqrt(vx * vx + vy * vy + vz * vz)
    if speed <= CREEP:
        return CREEP
    aside, straight = thrown(speed, z - az)
    spare = MARGIN - TUMBLE
    share = min(
        (x - ax + spare) / max(aside, -vx * straight),
        (bx - x + spare) / max(aside, vx * straight),
        (y - ay + spare) / max(aside, -vy * straight),
        (by - y + spare) / max(aside, vy * straight),
    )
    return speed * share


def thrown(speed: float, height: float) -> tuple[float, float]:
    """Say how far a hit may throw the robot before it lies: TUMBLE comes to that.

    Args:
        speed: At the hit [m/s].
        height: Above the margin of the floor [m].

    Returns:
        How far to any side [m], and for how long it goes straight on [s].
    """
    fall = fall_time(height) + SLIDE
    share = ASIDE + OFF_TOP * within(height - TOP, 0.0, 1.0)
    return share * speed * fall, fall + BOUNCE + LATE


def fall_time(height: float) -> float:
    """Say how long the robot falls [s] from a `height` above the margin of the floor [m].

    In LAND, where the floor is no face, from HEIGHT_MAX.
    """
    height += FLOOR_MARGIN
    if not height < HEIGHT_MAX:
        height = HEIGHT_MAX
    return sqrt(2.0 / GRAVITY * max(height, 0.0))


def shortened(a: Vector, length_max: float) -> Vector:
    """Give `a` [m/s] if it is at most `length_max` [m/s] long, else its direction with that length.

    Zero if a component is not a number, or infinite.
    """
    x, y, z = a
    largest = max(abs(x), abs(y), abs(z))
    if largest > length_max:
        # Scaled down first: the square of a huge but finite number overflows to infinity.
        scale = length_max / largest
        x, y, z = x * scale, y * scale, z * scale
    square = x * x + y * y + z * z
    if square <= length_max * length_max:
        return a if largest <= length_max else (x, y, z)
    scale = length_max / sqrt(square)
    if not scale <= 1.0:
        return ZERO
    return (x * scale, y * scale, z * scale)


def towards(start: Vector, end: Vector, step: float) -> Vector:
    """Give the point from `start` to `end` at most `step` away from `start`, all in [m/s]."""
    (ax, ay, az), (bx, by, bz) = start, end
    x, y, z = bx - ax, by - ay, bz - az
    square = x * x + y * y + z * z
    if square <= step * step:
        return end
    share = step / sqrt(square)
    return (ax + share * x, ay + share * y, az + share * z)


def held_back(before: Vector, after: Vector, step: float) -> Vector:
    """Give `after`, but no more than `step` of what leads away from rest, all in [m/s].

    Where the fence has the robot come back in one axis while another speeds up, each axis alone may
    be within the cap and their sum beyond it. Slowing down is never held back.

    Args:
        before: Finite [m/s], shape (3,).
        after: Finite [m/s], shape (3,).
        step: Longest way from `before` that speeds up [m/s].
    """
    (ax, ay, az), (bx, by, bz) = before, after
    x, y, z = growth(ax, bx), growth(ay, by), growth(az, bz)
    square = x * x + y * y + z * z
    if square <= step * step:
        return after
    excess = 1.0 - step / sqrt(square)
    return (
        bx - copysign(excess * x, bx),
        by - copysign(excess * y, by),
        bz - copysign(excess * z, bz),
    )


def growth(before: float, after: float) -> float:
    """Say by how much `after` is farther from rest than `before` on the same side, in [m/s]."""
    if after < 0.0:
        before, after = -before, -after
    return max(after - max(before, 0.0), 0.0)


def upright(reference: Vector, before: Vector, climb: float, speed_max: float) -> Vector:
    """Keep the reference from going down so far ahead of the robot that it would turn over.

    Args:
        reference: Wanted [m/s], world frame, shape (3,).
        before: What it was a tick ago [m/s], at most `speed_max` long, shape (3,).
        climb: Vertical velocity of the robot [m/s].
        speed_max: Of the result [m/s].
    """
    x, y, z = reference
    lowest = min(before[2], climb - SINK_LAG)
    return shortened((x, y, lowest), speed_max) if z < lowest else reference


AGE_MAX_NS = 10_000_000_000
"""Commands that are older are never flown [ns], whatever an experiment says."""
GROUND_MIN_NS = 10_000_000_000
"""A robot on the ground waits for a mission's first command for so long at least [ns]: it comes a
round trip behind the start, 0.6 s by `satellite`, or some, if one end has not heard the other."""
RAMP_MIN = 1.0
"""Out of HOLD the reference is led slowly for so long at least [s]."""
RANGE = 1000.0
"""Largest number of a command that is shortened to a cap, not refused [m/s, rad/s]: no controller
asks a robot for more. One that does has a bug, and its direction is as wrong as its length.
Source: docs/reference/faults.md, "F23"."""


@dataclass(frozen=True, slots=True)
class Limits:
    """What the guard allows.

    Attributes:
        fence_low: Corner of the box that the base may not leave [m], world frame, shape (3,).
        fence_high: The opposite corner [m], shape (3,).
        command_age_max_ns: Age of the basis beyond which a command is not flown [ns].
        speed_max: Largest speed [m/s].
        acceleration_max: Largest change of the reference [m/s^2].
        yaw_rate_max: Largest yaw rate [rad/s].
        hold_max_ns: HOLD for so long in a mission ends in LAND [ns]; see `alone_max_ns`.
    """

    fence_low: Vector
    fence_high: Vector
    command_age_max_ns: int = 250_000_000
    speed_max: float = 6.0
    acceleration_max: float = 12.0
    yaw_rate_max: float = 1.0
    hold_max_ns: int = 60_000_000_000

    def __post_init__(self) -> None:
        """Refuse what would switch a limit off.

        Raises:
            ValueError: If a limit is not finite, not above 0 or, for the speed and the age, beyond
                what can be stopped in time; the message names it.
        """
        for name in self.__slots__[2:]:
            value = getattr(self, name)
            if not (isfinite(value) and value > 0):
                raise ValueError(f"guard: {name} is {value}; it has to be finite and above 0")
        if self.command_age_max_ns > AGE_MAX_NS:
            raise ValueError(f"guard: command_age_max_ns is {self.command_age_max_ns}, above 10 s")
        way = stopping_distance(self.speed_max, self.command_age_max_ns * 1e-9 + REACTION)
        if way > STOPPING_DISTANCE + 1e-4:
            raise ValueError(
                f"guard: speed_max is {self.speed_max:g} m/s, from which stopping takes {way:.2f} m"
                f" with commands that old; at most {STOPPING_DISTANCE:g} m are allowed"
            )
        for low, high in zip(self.fence_low, self.fence_high, strict=True):
            if not (isfinite(low) and isfinite(high) and high - low > FLOOR_MARGIN + MARGIN):
                raise ValueError(f"guard: a fence from {low:g} to {high:g} m leaves no room")

    @property
    def ramp_ns(self) -> int:
        """How long the reference grows by no more than BRAKE after a HOLD [ns]: to the cap.

        By time alone: the first commands after a silence rest, and a ramp that ended where the
        reference has caught up with them would be none.
        Source: docs/reference/plant.md, "Leaving HOLD".
        """
        return round(max(RAMP_MIN, self.speed_max / BRAKE) * 1e9)

    def alone_max_ns(self, flies: bool) -> int:
        """How long a robot in a mission waits for its cloud before LAND [ns]."""
        return self.hold_max_ns if flies else max(self.hold_max_ns, GROUND_MIN_NS)

    def too_old(self, beyond_ns: int) -> str:
        """Say by how much the newest command is too old, so many nanoseconds beyond the limit."""
        age, limit = self.command_age_max_ns + beyond_ns, self.command_age_max_ns
        return f"command age {age * 1e-9:.3f} s above {limit * 1e-9:.3f} s"

    def left_alone(self, flies: bool) -> str:
        """Say for how long it has waited."""
        return f"held for {self.alone_max_ns(flies) * 1e-9:g} s without the cloud"

    def inside(self) -> tuple[Vector, Vector]:
        """Give the fence's corners with the margins taken off [m], shape (3,) each."""
        (ax, ay, az), (bx, by, bz) = self.fence_low, self.fence_high
        low = (ax + MARGIN, ay + MARGIN, az + FLOOR_MARGIN)
        return low, (bx - MARGIN, by - MARGIN, bz - MARGIN)
