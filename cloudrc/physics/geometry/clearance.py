# SPDX-License-Identifier: Apache-2.0

"""Represent a robot by spheres, and compute their distance from tubes and other obstacles.

A tube is an ideal hollow cylinder with flat ends. The physics builds each tube from flat staves,
which deviate from the cylinder by up to 3.2 mm.

Source: docs/reference/plant.md, "Staves".
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from cloudrc.physics.geometry.obstacles import Obstacle
from cloudrc.physics.geometry.scene import Scene

Array = NDArray[np.float64]

CLEARANCE_SHOWN = 0.40
"""Upper end of the colour scale in figures and scenes [m]; inside a tube no clearance is larger."""

_CHUNK = 100  # poses per batch: 100 x 225 points fit in the processor's cache
_STRIDE = 32  # `least_clearance` begins with every 32nd pose
_ROUNDING = 1e-9  # more than the rounding errors of a bound [m]


class Spheres(NamedTuple):
    """Spheres, body frame: centres `positions` [m], shape (k, 3), and `radii` [m], shape (k,)."""

    positions: Array
    radii: Array


def ball(radius: float) -> Spheres:
    """Return the hull of a robot that is inside a ball of `radius` [m] about its base."""
    return Spheres(np.zeros((1, 3)), np.array([radius]))


NO_SIZE = ball(0.0)
"""Hull of a robot whose size is not known."""


def rotations(orientations_wxyz: Array) -> Array:
    """Return the rotation matrices of n orientations, body to world, shape (n, 3, 3).

    Each row of `orientations_wxyz` is a unit quaternion, shape (n, 4).
    """
    w, x, y, z = np.moveaxis(orientations_wxyz, -1, 0)
    rows = (
        (1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)),
        (2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)),
        (2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)),
    )
    matrices: Array = np.stack([np.stack(row, axis=1) for row in rows], axis=1)
    return matrices


def place_points(points: Spheres, positions: Array, orientations_wxyz: Array) -> Array:
    """Return the centres of the robot's spheres at n poses [m], world frame, shape (n, k, 3).

    `points` are the k spheres in the body frame. `positions` are those of the base [m], world
    frame, shape (n, 3). Each row of `orientations_wxyz` is a unit quaternion, body to world, shape
    (n, 4).
    """
    rotation = rotations(orientations_wxyz)
    placed: Array = points.positions @ rotation.transpose(0, 2, 1)
    placed += positions[:, None, :]
    return placed


def clearance_per_obstacle(
    obstacles: Sequence[Obstacle],
    positions: ArrayLike,
    orientations_wxyz: ArrayLike,
    points: Spheres,
) -> Array:
    """Compute the robot's distance from each of m obstacles [m], shape (n, m).

    The distance is that of the nearest of the robot's `points`; it is negative inside an obstacle.
    `positions` [m] and `orientations_wxyz` (unit quaternions) are as for `place_points`.
    """
    at = np.asarray(positions, dtype=np.float64).reshape(-1, 3)
    facing = np.asarray(orientations_wxyz, dtype=np.float64).reshape(-1, 4)
    result = np.full((len(at), len(obstacles)), np.inf)
    for start in range(0, len(at) if obstacles else 0, _CHUNK):
        part = slice(start, start + _CHUNK)
        placed = place_points(points, at[part], facing[part])
        for index, obstacle in enumerate(obstacles):
            result[part, index] = (obstacle.distance(placed) - points.radii).min(axis=1)
    return result


def clearance(
    obstacles: Sequence[Obstacle],
    positions: ArrayLike,
    orientations_wxyz: ArrayLike,
    points: Spheres,
) -> Array:
    """Compute the distance of the robot's `points` from the nearest obstacle [m], shape (n,).

    `positions` [m] have the shape (n, 3), `orientations_wxyz` (unit quaternions, body to world) the
    shape (n, 4). Without obstacles the distance is infinite.
    """
    distances = clearance_per_obstacle(obstacles, positions, orientations_wxyz, points)
    nearest: Array = distances.min(axis=1, initial=np.inf)
    return nearest


def least_clearance(
    obstacles: Sequence[Obstacle], at: Array, facing: Array, points: Spheres
) -> float:
    """Compute the smallest `clearance` of n poses along a path [m]; infinite without poses.

    `at` has the positions of the base [m], shape (n, 3), `facing` the orientations (unit
    quaternions), shape (n, 4).

    The result is exactly that of all poses, although most poses are skipped. Between two poses no
    point of the robot moves further than s = |dp| + 2 R |dq| (base position p, quaternion q, and
    R the distance of the farthest point from the base). So between poses with the clearances a and
    b the clearance is at least (a + b - s) / 2. An interval is halved only if this bound is below
    the smallest clearance found so far.
    """
    if not len(at) or not obstacles:
        return np.inf
    reach = np.linalg.norm(points.positions, axis=1)
    turned = np.linalg.norm(np.diff(facing, axis=0), axis=1)
    moved = np.linalg.norm(np.diff(at, axis=0), axis=1) + 2 * reach.max() * turned
    path = np.concatenate(([0.0], np.cumsum(moved)))
    # Distance of each pose from each obstacle, shape (m, n). At first a lower bound: no point is
    # nearer than the base by more than its distance from the base and its radius. Where the bound
    # is below the smallest clearance found so far, the distance of all points replaces it.
    least = np.stack([each.distance(at) for each in obstacles]) - (reach + points.radii).max()
    first = least.min(axis=0).argmin()
    nearest = clearance(obstacles, at[[first]], facing[[first]], points)[0]
    found = np.empty(len(at))
    new = np.unique(np.append(np.arange(0, len(at), _STRIDE), len(at) - 1))
    starts, ends = new[:-1], new[1:]
    while len(new):
        for each, known in zip(obstacles, least, strict=True):
            near = new[known[new] <= nearest + _ROUNDING]
            known[near] = clearance([each], at[near], facing[near], points)
            nearest = min(nearest, known[near].min(initial=np.inf))
        found[new] = least[:, new].min(axis=0)
        bound = (found[starts] + found[ends] - (path[ends] - path[starts])) / 2
        open_ = (ends - starts > 1) & (bound <= nearest + _ROUNDING)
        starts, ends = starts[open_], ends[open_]
        new = (starts + ends) // 2
        starts, ends = np.concatenate((starts, new)), np.concatenate((new, ends))
    return float(nearest)


def inside_tube(scene: Scene, positions: Array) -> NDArray[np.bool_]:
    """Return whether the base is in the bore of a tube, shape (n,).

    That is between both ends, and nearer to the axis than the inner radius. `positions` are those
    of the base [m], world frame, shape (n, 3).
    """
    result = np.zeros(len(positions), dtype=np.bool_)
    for tube in scene.tubes:
        relative = positions - np.asarray(tube.centre)
        s = relative @ np.asarray(tube.axis)
        r = np.linalg.norm(relative - s[:, None] * np.asarray(tube.axis), axis=1)
        result |= (np.abs(s) <= 0.5 * tube.length) & (r < tube.inner)
    return result
