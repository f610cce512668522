# SPDX-License-Identifier: Apache-2.0

"""Check whether a robot can fly to a position: the guard's limits, and obstacles in the way."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike, NDArray

from cloudrc.physics.geometry.clearance import Array, Spheres, clearance_per_obstacle
from cloudrc.physics.geometry.fence import Fence
from cloudrc.physics.geometry.obstacles import Obstacle

CLEARANCE_MIN = 0.04
"""Smallest distance of the robot from an obstacle, at a waypoint and on the way to it [m].
The value is above 32 mm, the steady error of a hover with the published gains."""
STEP_MIN = 0.02
"""Shortest step in which a straight way is checked [m]. Near a wall, a check without a
shortest step would not end."""


def outside_fence(fence: Fence, positions: Array, slack: ArrayLike = 0.0) -> NDArray[np.bool_]:
    """Return which positions are outside the box in which the guard lets the robot fly.

    `positions` are in [m], world frame, shape (n, 3). A position counts as inside if its distance
    from the box is at most `slack` [m], shape () or (n,), unless it is outside the fence. Only the
    walls concern a robot that stays on the ground.
    """
    axes = fence.axes
    at = positions[:, axes]
    within = np.clip(at, fence.low[axes], fence.high[axes])
    beyond = within - np.clip(within, fence.inner_low[axes], fence.inner_high[axes])
    outside: NDArray[np.bool_] = (at != within).any(axis=1)
    outside |= np.linalg.norm(beyond, axis=1) > np.asarray(slack) + 1e-9
    return outside


def find_overlapped(
    obstacles: Sequence[Obstacle], robot: Spheres, positions: Array, least: float = CLEARANCE_MIN
) -> NDArray[np.int64]:
    """Return for each position the index of the obstacle that the robot is too near to, shape (n,).

    The index is -1 if all obstacles are at least `least` [m] away from the level robot. `positions`
    are those of the base [m], world frame, inside or near the fence, shape (n, 3).
    """
    if not obstacles:
        return np.full(len(positions), -1, dtype=np.int64)
    distance = _distances(obstacles, robot, positions)
    return np.where(distance.min(axis=1) < least, distance.argmin(axis=1), -1)


def find_crossed(
    obstacles: Sequence[Obstacle], robot: Spheres, starts: Array, ends: Array
) -> NDArray[np.int64]:
    """Find the first obstacle along each of n straight ways to which the robot comes too near.

    Too near is a distance below `CLEARANCE_MIN`. The robot is level. A way may begin
    nearer to an obstacle than `CLEARANCE_MIN` if it leads away from this obstacle.

    `starts` and `ends` are positions of the base [m], world frame, inside or near the fence, shape
    (n, 3). Return the index of the obstacle for each way, -1 if there is none, shape (n,).
    """
    result = np.full(len(starts), -1, dtype=np.int64)
    length = np.linalg.norm(ends - starts, axis=1)
    flown = np.zeros(len(starts))
    flying = np.arange(len(starts) if obstacles else 0)
    least = None  # distance from each obstacle below which a way leads into it [m], shape (n, m)
    while len(flying):
        share = flown[flying] / np.maximum(length[flying], 1e-12)
        at = starts[flying] + share[:, None] * (ends - starts)[flying]
        distances = _distances(obstacles, robot, at)
        if least is None:  # a way may begin near an obstacle, or press on it
            least = np.minimum(CLEARANCE_MIN, distances - STEP_MIN)
        room = distances - least[flying]
        touching = room.min(axis=1) < 0.0
        result[flying[touching]] = room[touching].argmin(axis=1)
        going = ~touching & (flown[flying] < length[flying])
        step = np.maximum(distances.min(axis=1) - CLEARANCE_MIN, STEP_MIN)[going]
        flying = flying[going]
        flown[flying] = np.minimum(flown[flying] + step, length[flying])
    return result


def _distances(obstacles: Sequence[Obstacle], robot: Spheres, positions: Array) -> Array:
    """Return the distances of the robot with a yaw of 0 from each obstacle [m], shape (n, m)."""
    level = np.broadcast_to((1.0, 0.0, 0.0, 0.0), (len(positions), 4))
    return clearance_per_obstacle(obstacles, positions, level, robot)
