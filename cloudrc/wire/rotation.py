# SPDX-License-Identifier: Apache-2.0

"""Rotate vectors between the frames of the robot and of the world, in plain floats."""

from __future__ import annotations

from collections.abc import Sequence

from cloudrc.wire.messages import Quaternion, Vector


def rotate(orientation_wxyz: Quaternion, vector: Sequence[float]) -> Vector:
    """Rotate a vector from the body frame to the world frame: v + 2 · u x (u x v + w · v).

    `orientation_wxyz` is a unit quaternion (w, u), body to world, shape (4,); Rodrigues' formula.
    """
    w, x, y, z = orientation_wxyz
    a, b, c = vector
    p, q, r = y * c - z * b + w * a, z * a - x * c + w * b, x * b - y * a + w * c
    return a + 2 * (y * r - z * q), b + 2 * (z * p - x * r), c + 2 * (x * q - y * p)
