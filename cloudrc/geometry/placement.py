"""Check whether the robot may fly to a position: the fence, the pipes, and the way there."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from cloudrc.geometry import fence
from cloudrc.geometry.clearance import clearance_per_pipe
from cloudrc.geometry.robot import Array, hull_points
from cloudrc.geometry.scene import Scene
from cloudrc.messages import Vector

_SEARCH = 1.5  # [m] largest distance of a suggested legal point


def outside_fence(positions: Array) -> NDArray[np.bool_]:
    """Tell which positions of the base [m], world frame, shape (n, 3), are outside the fence."""
    outside: NDArray[np.bool_] = np.any((positions < fence.LOW) | (positions > fence.HIGH), axis=1)
    return outside


def find_overlapped_pipe(scene: Scene, positions: Array, yaws: Array) -> NDArray[np.int64]:
    """Find the pipe whose wall the base's box or the arm would overlap.

    The rotors do not count here; the metrics judge how near they come to a wall.

    Args:
        scene: The scene; its board does not count.
        positions: Positions of the base [m], world frame, shape (n, 3).
        yaws: Headings of the level robot [rad], shape (n,).

    Returns:
        Index of the pipe with the deepest overlap, or -1, shape (n,).
    """
    result = np.full(len(positions), -1, dtype=np.int64)
    # Points far outside the fence would overflow.
    near = np.flatnonzero(np.all(np.abs(positions) < 1e3, axis=1))
    if len(near) == 0 or not scene.pipes:
        return result
    facing = np.zeros((len(near), 4))
    facing[:, 0], facing[:, 3] = np.cos(yaws[near] / 2), np.sin(yaws[near] / 2)
    distance = clearance_per_pipe(scene, positions[near], facing, hull_points())
    result[near] = np.where(distance.min(axis=1) < 0, distance.argmin(axis=1), -1)
    return result


def find_crossed_pipe(scene: Scene, starts: Array, ends: Array) -> NDArray[np.int64]:
    """Find the pipe whose wall a straight way of the base's centre crosses.

    A way that only grazes a wall does not count, because the flight may deviate from the straight
    way.

    Args:
        scene: The scene; its board does not count.
        starts: Starts of the ways [m], world frame, not far outside the fence, shape (n, 3).
        ends: Ends of the ways [m], world frame, likewise, shape (n, 3).

    Returns:
        Index of the last such pipe, or -1, shape (n,).
    """
    result = np.full(len(starts), -1, dtype=np.int64)
    for index, pipe in enumerate(scene.pipes):
        axis = np.asarray(pipe.axis)
        from_centre, along = starts - np.asarray(pipe.centre), ends - starts
        depth, deeper = from_centre @ axis, along @ axis
        away, farther = from_centre - depth[:, None] * axis, along - deeper[:, None] * axis
        # The way meets the middle of the wall where |away + t farther| = radius.
        a, b = np.sum(farther**2, axis=1), 2 * np.sum(away * farther, axis=1)
        c = np.sum(away**2, axis=1) - ((pipe.inner + pipe.outer) / 2) ** 2
        with np.errstate(invalid="ignore", divide="ignore"):  # no such t, or parallel to the axis
            root = np.sqrt(b**2 - 4 * a * c)
            for t in ((-b - root) / (2 * a), (-b + root) / (2 * a)):
                meets = (t >= 0) & (t <= 1) & (np.abs(depth + t * deeper) <= pipe.length / 2)
                result[meets] = index
    return result


def find_nearest_legal(scene: Scene, position: Vector, yaw: float) -> Vector | None:
    """Find a legal point near a position.

    The search goes along the axes, and towards and away from the axes of the pipes. Candidates are
    whole centimetres, so that the printed point is the checked one.

    Args:
        scene: The scene.
        position: Position of the base [m], world frame, shape (3,).
        yaw: Heading [rad].

    Returns:
        A point inside the fence without an overlap [m], shape (3,); None if there is none within
        1.5 m.
    """
    start = np.array(fence.clamp(position))
    directions = [*np.eye(3), *-np.eye(3)]
    for pipe in scene.pipes:
        relative = start - np.asarray(pipe.centre)
        radial = relative - (relative @ np.asarray(pipe.axis)) * np.asarray(pipe.axis)
        norm = float(np.linalg.norm(radial))
        if 0 < norm < pipe.outer + _SEARCH:
            directions += [radial / norm, -radial / norm]
    steps = np.arange(0, _SEARCH, 0.02)
    around = start + steps[:, None, None] * np.array(directions)
    candidates = np.round(around.reshape(-1, 3), 2)
    legal = ~outside_fence(candidates)
    legal &= find_overlapped_pipe(scene, candidates, np.full(len(candidates), yaw)) < 0
    if not legal.any():
        return None
    candidates = candidates[legal]
    best = candidates[np.linalg.norm(candidates - start, axis=1).argmin()]
    return float(best[0]), float(best[1]), float(best[2])
