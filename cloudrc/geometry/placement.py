"""Check whether a robot can fly to a position: the guard's limits, and obstacles in the way.

The `robot` is represented by spheres that are dense enough to check a path.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike, NDArray

from cloudrc.geometry.clearance import Array, Spheres, clearance_per_obstacle
from cloudrc.geometry.fence import Fence
from cloudrc.geometry.obstacles import Obstacle
from cloudrc.geometry.scene import Tube
from cloudrc.messages import Vector

CLEARANCE_MIN = 0.04
"""Smallest distance of the whole robot from an obstacle, at a waypoint and on the way to it [m].
The value is above 32 mm, the steady error of a hover with the published gains."""
STEP_MIN = 0.02
"""Shortest step in which a straight way is checked [m]. Near a wall, a check without a
shortest step would not end."""
_SEARCH = 1.5  # [m] largest distance of a suggested legal point
_AT_ONCE = 50  # number of candidates whose ways are checked together
_FAR = 1e3  # [m] limit of coordinates, so that no square overflows


def outside_fence(
    fence: Fence, positions: Array, slack: ArrayLike = 0.0, *, planar: bool = False
) -> NDArray[np.bool_]:
    """Return which positions are outside the box in which the guard lets the robot fly.

    `positions` are in [m], world frame, shape (n, 3). A position counts as inside if its distance
    from the box is at most `slack` [m], shape () or (n,), unless it is outside the fence. Only the
    walls concern a `planar` robot.
    """
    axes = slice(2 if planar else 3)
    low, high = np.array(fence.low)[axes], np.array(fence.high)[axes]
    at = np.clip(positions[:, axes], low - _FAR, high + _FAR)
    nearest = np.clip(at, fence.inner_low[axes], fence.inner_high[axes])
    outside: NDArray[np.bool_] = np.linalg.norm(at - nearest, axis=1) > np.asarray(slack) + 1e-9
    outside |= ~np.all((at >= low) & (at <= high), axis=1)
    return outside


def find_overlapped(
    obstacles: Sequence[Obstacle],
    robot: Spheres,
    positions: Array,
    yaws: Array,
    least: float = CLEARANCE_MIN,
) -> NDArray[np.int64]:
    """Return for each pose the index of the obstacle that the robot is too near to, shape (n,).

    The index is -1 if all obstacles are at least `least` [m] away. `positions` are those of the
    base [m], world frame, shape (n, 3); `yaws` are the headings of the level robot [rad], shape
    (n,).
    """
    if not obstacles:
        return np.full(len(positions), -1, dtype=np.int64)
    distance = _distances(obstacles, robot, np.clip(positions, -_FAR, _FAR), yaws)
    return np.where(distance.min(axis=1) < least, distance.argmin(axis=1), -1)


def find_crossed(
    obstacles: Sequence[Obstacle],
    robot: Spheres,
    starts: Array,
    ends: Array,
    yaws: Array | float = 0.0,
) -> NDArray[np.int64]:
    """Find the first obstacle along each of n straight ways to which the robot comes too near.

    Too near is a distance below `CLEARANCE_MIN`. The robot is level. A way may begin
    nearer to an obstacle than `CLEARANCE_MIN` if it leads away from this obstacle.

    `starts` and `ends` are positions of the base [m], world frame, inside or near the fence, shape
    (n, 3); `yaws` are the headings on the ways [rad], shape (n,) or (). Return the index of the
    obstacle for each way, -1 if there is none, shape (n,).
    """
    result = np.full(len(starts), -1, dtype=np.int64)
    facing = np.broadcast_to(yaws, len(starts))
    length = np.linalg.norm(ends - starts, axis=1)
    flown = np.zeros(len(starts))
    least = np.full(len(starts), np.inf)
    flying = np.arange(len(starts) if obstacles else 0)
    while len(flying):
        share = flown[flying] / np.maximum(length[flying], 1e-12)
        at = starts[flying] + share[:, None] * (ends - starts)[flying]
        distances = _distances(obstacles, robot, at, facing[flying])
        nearest = distances.min(axis=1)
        if np.isinf(least).any():  # a way may begin near a wall
            least = np.minimum(CLEARANCE_MIN, nearest - STEP_MIN)
        touching = nearest < least[flying]
        result[flying[touching]] = distances[touching].argmin(axis=1)
        going = ~touching & (flown[flying] < length[flying])
        step = np.maximum(nearest - CLEARANCE_MIN, STEP_MIN)[going]
        flying = flying[going]
        flown[flying] = np.minimum(flown[flying] + step, length[flying])
    return result


def find_nearest_legal(
    fence: Fence,
    obstacles: Sequence[Obstacle],
    robot: Spheres,
    position: Vector,
    yaw: float,
    before: Vector | None = None,
) -> Vector | None:
    """Find a point that the guard allows and that is clear of obstacles; None if none is near.

    The search begins at `position` (of the base, [m], world frame), moved into the guard's limits.
    It goes up to 1.5 m along x, y and z, and towards and away from the axes of the tubes.
    The coordinates of the point are whole centimetres, so that a message can show them exactly.

    `yaw` is the heading of the level robot [rad]. If `before` [m] is given, the straight way from
    there to the point is also clear of obstacles.
    """
    start = np.clip(position, fence.inner_low, fence.inner_high)
    directions = [*np.eye(3), *-np.eye(3)]
    for tube in (each for each in obstacles if isinstance(each, Tube)):
        relative = start - np.asarray(tube.centre)
        radial = relative - (relative @ np.asarray(tube.axis)) * np.asarray(tube.axis)
        norm = float(np.linalg.norm(radial))
        if 0 < norm < tube.outer + _SEARCH:
            directions += [radial / norm, -radial / norm]
    steps = np.arange(0, _SEARCH, 0.02)
    around = start + steps[:, None, None] * np.array(directions)
    candidates = np.round(around.reshape(-1, 3), 2)
    legal = ~outside_fence(fence, candidates)
    legal &= find_overlapped(obstacles, robot, candidates, np.full(len(candidates), yaw)) < 0
    candidates = candidates[legal]
    candidates = candidates[np.linalg.norm(candidates - start, axis=1).argsort(kind="stable")]
    for part in np.array_split(candidates, max(1, len(candidates) // _AT_ONCE)):
        if before is not None:
            starts = np.tile(before, (len(part), 1))
            part = part[find_crossed(obstacles, robot, starts, part, yaw) < 0]
        if len(part):
            x, y, z = part[0].tolist()
            return x, y, z
    return None


def _distances(
    obstacles: Sequence[Obstacle], robot: Spheres, positions: Array, yaws: Array
) -> Array:
    facing = np.zeros((len(positions), 4))
    facing[:, 0], facing[:, 3] = np.cos(yaws / 2), np.sin(yaws / 2)
    return clearance_per_obstacle(obstacles, positions, facing, robot)
