# SPDX-License-Identifier: Apache-2.0

"""Functions that keep a velocity reference within the limits of the guard.

The limits come from world's experiment; no message changes them. `config.load.ResolvedGuard` checks
each limit, so no value switches a limit off. Functions accept NaN and infinity unless their
docstring says otherwise; for this, comparisons are written so that NaN leads to the safe branch.
`tests/world/guard/test_proof.py` proves the bounds of the scalar functions for all floats.
"""

from __future__ import annotations

from collections.abc import Iterable
from math import copysign, inf, sqrt

from cloudrc.config.profile import COMMAND_AGE_MS
from cloudrc.physics.geometry.fence import FLOOR_MARGIN
from cloudrc.wire.messages import ZERO, Vector

REACTION = 0.2
"""Time from the start of braking until the robot decelerates as its robot.yaml promises [s].
Source: docs/safety.md, "Stop rule"."""
FENCE_REACTION = 0.6
"""Reaction time in the stop rule at the walls and the ceiling of the fence [s]. With the braking a
of the robot, the guard limits the speed v so that
FENCE_REACTION · v + v^2/(2a) <= distance - WALL_MARGIN. At the floor the guard uses REACTION and
FLOOR_MARGIN, because the robot can stop a descent quickly.
With REACTION and 0.1 m at the walls, too, a hostile cloud can move the robot 0.3 m beyond the
fence, because the robot reacts with a delay. Source: docs/safety.md, "Stop rule"."""
ROOM = 1e-6
"""Distance that is larger than any rounding error of the stop rule [m]."""
FAR = 1e6
"""Distance from a face of the fence beyond which the face limits no speed [m]."""
RETURN_GAIN, RETURN_SPEED_MAX = 1.0, 0.5
"""A robot that is too near to a face of the fence, or outside, flies back: velocity per distance
[1/s], and largest speed [m/s]."""
LOW_HEIGHT, LOW_SPEED = 0.25, 1.0
"""The horizontal speed is limited to LOW_SPEED [m/s] while the robot is less than LOW_HEIGHT [m]
above the fence's floor."""
SINK_LEAD_MAX = 0.5
"""The velocity reference may sink at most this much faster than the robot [m/s]. With a larger
difference the low-level controller would turn the robot over."""
ROUNDING_FACTOR = 1.0 - 2.0**-45
"""Factor on the speed cap, just below 1, so that rounding errors never exceed the cap."""


def clamp(value: float, low: float, high: float) -> float:
    """Limit `value` to the interval from `low` to `high`, in any unit; NaN becomes `low`."""
    if value >= high:
        return high
    return value if value > low else low


def stop_coefficient(braking: float) -> float:
    """Return the braking distance divided by the square of the speed [s^2/m].

    `braking` is the deceleration of the robot [m/s^2].
    """
    return 1.0 / (2.0 * braking)


def approach_speed(distance: float, stop: float, reaction: float = FENCE_REACTION) -> float:
    """Return the largest velocity towards a face of the fence [m/s].

    The result v solves reaction · v + stop · v^2 = distance. `distance` is the distance to the face
    minus the fence's margin [m], `stop` the robot's `stop_coefficient` [s^2/m], `reaction` the
    reaction time [s]. If `distance` is negative, v is negative, so that the robot returns.
    """
    if distance > FAR:
        return inf
    if distance > 0.0:
        root = sqrt(reaction * reaction + 4.0 * stop * distance)
        return 2.0 * distance / (reaction + root)
    return max(RETURN_GAIN * distance, -RETURN_SPEED_MAX) if distance < 0.0 else 0.0


def limit_to_fence(
    velocity: Vector, position: Vector, low: Vector, high: Vector, stop: float
) -> Vector:
    """Slow a finite `velocity` [m/s], axis by axis, so that the robot can stop before the fence.

    Near the floor the horizontal velocity is limited, too, because an arm that touches the floor
    at speed turns the robot over. `position` is that of the base [m]. `low` and `high` are the
    corners of the box in which the robot may fly [m]. All are in the world frame, shape (3,).
    `stop` is the robot's `stop_coefficient` [s^2/m].
    """
    (vx, vy, vz), (x, y, z), (ax, ay, az), (bx, by, bz) = velocity, position, low, high
    u, v, w = abs(vx), abs(vy), abs(vz)
    u = u * (FENCE_REACTION + stop * u) + ROOM
    v = v * (FENCE_REACTION + stop * v) + ROOM
    w = w * (FENCE_REACTION + stop * w) + ROOM
    if ax + u <= x <= bx - u and ay + v <= y <= by - v and az + w <= z <= bz - w:
        return velocity  # the usual case: no face is near, which takes less time to find out
    if not z >= az - FLOOR_MARGIN + LOW_HEIGHT:
        vx, vy, _ = limit_length((vx, vy, 0.0), LOW_SPEED)
    return (
        clamp(vx, -approach_speed(x - ax, stop), approach_speed(bx - x, stop)),
        clamp(vy, -approach_speed(y - ay, stop), approach_speed(by - y, stop)),
        # At most 0: a robot that stands on the floor does not have to climb.
        clamp(vz, min(0.0, -approach_speed(z - az, stop, REACTION)), approach_speed(bz - z, stop)),
    )


def limit_length(a: Vector, length_max: float) -> Vector:
    """Shorten the velocity `a` to `length_max` [m/s]; return zero for NaN or infinity."""
    x, y, z = a
    largest = max(abs(x), abs(y), abs(z))
    if largest > length_max:
        # Scale down first: the square of a huge but finite number overflows to infinity.
        scale = length_max / largest
        x, y, z = x * scale, y * scale, z * scale
    square = x * x + y * y + z * z
    if square <= length_max * length_max:
        return a if largest <= length_max else (x, y, z)
    scale = length_max / sqrt(square)
    if not scale <= 1.0:
        return ZERO
    return (x * scale, y * scale, z * scale)


def within(velocities: Iterable[Vector], most: float) -> bool:
    """Return whether each component of each velocity is a number from -`most` to `most` [m/s]."""
    for x, y, z in velocities:  # a plan comes with each command: `all` takes longer
        if not (abs(x) <= most and abs(y) <= most and abs(z) <= most):
            return False
    return True


def limit_growth(before: Vector, after: Vector, step: float) -> Vector:
    """Return the velocity `after`, slowed so that the speed grows by at most `step` [m/s].

    `before` and `after` are the velocities at the start and at the end of a physics step [m/s].
    Both are finite. The limit applies to all axes together: the fence may reverse the velocity of
    one axis while another axis gains speed.
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
    """Return by how much one component of a velocity grows in the direction of `after`.

    `before`, `after` and the result are in [m/s]. A component that shrinks gives 0. A component
    that changes its sign grows from 0.
    """
    if after < 0.0:
        before, after = -before, -after
    return max(after - max(before, 0.0), 0.0)


def limit_sink(reference: Vector, before: Vector, climb: float, speed_max: float) -> Vector:
    """Limit the downward speed of the velocity `reference`, so that the robot does not turn over.

    `before` is the velocity reference of the last step. `climb` is the vertical velocity of the
    robot, upwards. `speed_max` is the largest speed of `before` and of the result. All in [m/s].
    """
    x, y, z = reference
    lowest = min(before[2], climb - SINK_LEAD_MAX)
    return limit_length((x, y, lowest), speed_max) if z < lowest else reference


AGE_MAX_NS = COMMAND_AGE_MS[1] * 1_000_000
"""Largest value of guard.command_age_max_ms that an experiment may set, in [ns]."""
GROUND_WAIT_MIN_NS = 10_000_000_000
"""Shortest time for which a robot on the ground waits for the first command of its mission [ns]."""
RAMP_MIN = 1.0
"""Smallest value of `ramp_ns`, in [s]."""
COMMAND_MAX = 1000.0
"""Largest component of a command that the guard accepts [m/s, rad/s]. A command with a larger
component comes from a bug, so its direction cannot be trusted either.
Source: docs/reference/faults.md, "F23"."""


def ramp_ns(speed_max: float, braking: float) -> int:
    """Return how long after a HOLD the acceleration of the reference is limited to `braking` [ns].

    In this time the robot can reach its highest speed, `speed_max` [m/s]; `braking` is in [m/s^2].
    The limit does not end earlier when the reference reaches the command, because the first
    commands after a silence may be zero.
    Source: docs/safety.md, "Leaving HOLD".
    """
    return round(max(RAMP_MIN, speed_max / braking) * 1e9)
