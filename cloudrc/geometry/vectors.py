"""Move a vector towards another one by at most a given length."""

from __future__ import annotations

from math import sqrt

from cloudrc.messages import Vector


def step_towards(start: Vector, end: Vector, step: float) -> Vector:
    """Move a velocity from `start` towards `end` by at most `step`, all in [m/s]."""
    (ax, ay, az), (bx, by, bz) = start, end
    x, y, z = bx - ax, by - ay, bz - az
    square = x * x + y * y + z * z
    if square <= step * step:
        return end
    share = step / sqrt(square)
    return (ax + share * x, ay + share * y, az + share * z)
