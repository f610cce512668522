"""Compute the distance between the robot and the walls of the pipes.

A pipe is an ideal hollow cylinder with flat ends. The physics builds each pipe from flat staves,
which deviate from the cylinder by up to 3.2 mm.

Source: docs/reference/plant.md, "Staves".
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from cloudrc.geometry.robot import Array, Spheres, key_points, place_points
from cloudrc.geometry.scene import Pipe, Scene

_CHUNK = 100  # poses per batch: 100 x 225 points fit in the processor's cache


def distance_to_pipe(pipe: Pipe, points: Array) -> Array:
    """Compute the signed distance of points to a pipe's wall.

    In the plane of s (along the axis) and r (distance from the axis) the wall is a rectangle. The
    result is the distance to that rectangle.

    Args:
        pipe: The hollow cylinder.
        points: Points [m], world frame, shape (..., 3).

    Returns:
        Distance [m], shape (...): negative inside the wall, positive outside and in the bore.
    """
    relative = points - np.asarray(pipe.centre)
    s = relative @ np.asarray(pipe.axis)
    r_squared = np.einsum("...i,...i->...", relative, relative) - s * s
    r = np.sqrt(np.maximum(r_squared, 0.0))
    beyond_end = np.abs(s) - 0.5 * pipe.length
    beyond_face = np.abs(r - 0.5 * (pipe.inner + pipe.outer)) - 0.5 * (pipe.outer - pipe.inner)
    nearest: Array = np.minimum(np.maximum(beyond_end, beyond_face), 0.0)
    np.maximum(beyond_end, 0.0, out=beyond_end)
    np.maximum(beyond_face, 0.0, out=beyond_face)
    nearest += np.sqrt(beyond_end * beyond_end + beyond_face * beyond_face)
    return nearest


def clearance_per_pipe(
    scene: Scene,
    positions: ArrayLike,
    orientations_wxyz: ArrayLike,
    points: Spheres | None = None,
) -> Array:
    """Compute the robot's distance from the wall of each pipe.

    Args:
        scene: The scene.
        positions: Positions of the base [m], world frame, shape (n, 3).
        orientations_wxyz: Orientations of the base, unit quaternions, body to world, shape (n, 4).
        points: Points that represent the robot; default: `key_points()`.

    Returns:
        Distance of the nearest point [m], negative in a wall, shape (n, number of pipes).
    """
    points = points or key_points()
    at = np.asarray(positions, dtype=np.float64).reshape(-1, 3)
    facing = np.asarray(orientations_wxyz, dtype=np.float64).reshape(-1, 4)
    result = np.full((len(at), len(scene.pipes)), np.inf)
    for start in range(0, len(at) if scene.pipes else 0, _CHUNK):
        part = slice(start, start + _CHUNK)
        placed = place_points(points, at[part], facing[part])
        for index, pipe in enumerate(scene.pipes):
            distance = distance_to_pipe(pipe, placed) - points.radii
            result[part, index] = distance.min(axis=1)
    return result


def clearance(scene: Scene, positions: ArrayLike, orientations_wxyz: ArrayLike) -> Array:
    """Compute the robot's distance from the wall of the nearest pipe.

    Args:
        scene: The scene.
        positions: Positions of the base [m], world frame, shape (n, 3).
        orientations_wxyz: Orientations of the base, unit quaternions, body to world, shape (n, 4).

    Returns:
        Distance [m], negative in a wall, infinite in a scene without pipes, shape (n,).
    """
    nearest: Array = clearance_per_pipe(scene, positions, orientations_wxyz).min(
        axis=1, initial=np.inf
    )
    return nearest


def pipe_index(scene: Scene, positions: ArrayLike) -> NDArray[np.int64]:
    """Find the pipe whose bore contains the base.

    Args:
        scene: The scene.
        positions: Positions of the base [m], world frame, shape (n, 3).

    Returns:
        Index of the first such pipe, or -1, shape (n,).
    """
    at = np.asarray(positions, dtype=np.float64).reshape(-1, 3)
    result = np.full(len(at), -1, dtype=np.int64)
    for index in reversed(range(len(scene.pipes))):
        pipe = scene.pipes[index]
        relative = at - np.asarray(pipe.centre)
        s = relative @ np.asarray(pipe.axis)
        r = np.linalg.norm(relative - s[:, None] * np.asarray(pipe.axis), axis=1)
        result[(np.abs(s) <= 0.5 * pipe.length) & (r < pipe.inner)] = index
    return result


def inside_pipe(scene: Scene, positions: ArrayLike) -> NDArray[np.bool_]:
    """Tell whether the base is in a bore: |s| <= half the length, r < the inner radius.

    Args:
        scene: The scene.
        positions: Positions of the base [m], world frame, shape (n, 3).

    Returns:
        True where the base is in a bore, shape (n,).
    """
    return pipe_index(scene, positions) >= 0
