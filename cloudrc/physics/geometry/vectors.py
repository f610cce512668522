# SPDX-License-Identifier: Apache-2.0

"""Small functions of vectors and orientations, in plain floats."""

from __future__ import annotations

from math import atan2, remainder, sqrt, tau

from cloudrc.wire.messages import Quaternion, Vector


def step_towards(start: Vector, end: Vector, step: float) -> Vector:
    """Move a velocity from `start` towards `end` by at most `step`, all in [m/s]."""
    (ax, ay, az), (bx, by, bz) = start, end
    x, y, z = bx - ax, by - ay, bz - az
    square = x * x + y * y + z * z
    if square <= step * step:
        return end
    share = step / sqrt(square)
    return (ax + share * x, ay + share * y, az + share * z)


def turn_to(yaw: float, orientation_wxyz: Quaternion) -> float:
    """Return the shortest turn from a robot's yaw to `yaw`, both in [rad], from -pi to pi.

    The yaw is the direction of the nose on the ground, counter-clockwise from the world's x axis.
    `orientation_wxyz` is a unit quaternion, body to world.
    """
    w, x, y, z = orientation_wxyz
    measured = atan2(2.0 * (w * z + x * y), 1.0 - 2.0 * (y * y + z * z))
    return remainder(yaw - measured, tau)
