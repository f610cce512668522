# SPDX-License-Identifier: Apache-2.0

"""Perception: follows the gap between obstacles that lies in the direction of a course.

A direction is free if a disc of `radius_m`, the robot with a margin, can move `ahead_m` that way
before it touches a point of the scan. Free directions side by side are a gap. The robot goes to the
middle of the widest one near an obstacle, and along the course far from it.

Source: V. Sezer, M. Gokasan, "A novel obstacle avoidance algorithm: Follow the Gap Method",
Robotics and Autonomous Systems 60 (2012), 1123-1134, eq. (15).
Deviation: the paper computes gaps between discs, here a disc is moved along each ray.
"""

from __future__ import annotations

from math import cos, radians, sin

import numpy as np

from cloudrc.cloud.perceptions import Perception, Scan, point_at, yaw_of
from cloudrc.config.schema import Positive
from cloudrc.physics.geometry.solids import Array
from cloudrc.wire.messages import Odometry, Setpoint


class Gap(Perception):
    """Follows the widest gap within 90 degrees of a course."""

    def __init__(self, course: float, radius: float, ahead: float, weight: float) -> None:
        """Set course [rad], radius [m], ahead [m] and weight [m]; `build` describes them."""
        self._course, self._radius, self._ahead, self._weight = course, radius, ahead, weight

    def see(self, seen: Scan, odometry: Odometry) -> Setpoint:
        """Return the point `ahead` of the robot in the direction of the gap, or before it."""
        reaches = reach(seen, self._radius)
        turns = seen.angles + (yaw_of(odometry) - self._course)  # from the course
        turns = (turns + np.pi) % (2.0 * np.pi) - np.pi
        reaches[np.abs(turns) > np.pi / 2.0] = 0.0
        way = self._choose(turns, reaches, float(seen.ranges.min()))
        length = min(float(reaches[way]), self._ahead)
        return Setpoint(point_at(odometry, float(seen.angles[way]), length))

    def _choose(self, turns: Array, reaches: Array, nearest: float) -> int:
        """Return the number of the ray to follow; `nearest` is the distance of an obstacle [m]."""
        free = np.flatnonzero(np.diff(reaches >= self._ahead, prepend=False, append=False))
        gaps = [*zip(free[::2], free[1::2], strict=True)]
        if not gaps:
            return int(reaches.argmax())
        first, end = max(gaps, key=lambda gap: gap[1] - gap[0])
        middle = 0.5 * (turns[first] + turns[end - 1])
        wanted = middle / (1.0 + nearest / self._weight)  # the course itself is the turn 0
        return int(first + np.abs(turns[first:end] - wanted).argmin())


def reach(seen: Scan, radius: float) -> Array:
    """Return how far a disc of a radius [m] can move along each ray before it touches a point."""
    angles, hit = seen.angles.tolist(), np.isfinite(seen.ranges)
    # numpy's cosine and its product of matrices have other last bits on other processors.
    x, y, ranges = np.array([*map(cos, angles)]), np.array([*map(sin, angles)]), seen.ranges[hit]
    # Of each point on each ray, shape (rays, points).
    along = np.outer(x, x[hit] * ranges) + np.outer(y, y[hit] * ranges)
    inside = along * along + (radius * radius - ranges * ranges)  # minus the distance from the ray
    meets = (inside > 0.0) & (along > 0.0)
    touch = along - np.sqrt(inside, where=meets, out=np.zeros_like(along))
    found: Array = np.min(touch, axis=1, where=meets, initial=np.inf)
    return np.maximum(found, 0.0)


def build(
    course_deg: float = 0.0,
    radius_m: Positive = 0.4,
    ahead_m: Positive = 2.0,
    weight_m: Positive = 1.0,
) -> Gap:
    """Make a perception that follows the gap.

    Args:
        course_deg: Where the robot has to go, world frame; 0 is along x, 90 along y [deg].
        radius_m: Radius of the robot with a margin [m].
        ahead_m: How far a direction must be free, and how far ahead the setpoint is [m].
        weight_m: Distance from the nearest obstacle at which gap and course count the same [m].
    """
    return Gap(radians(course_deg), radius_m, ahead_m, weight_m)
