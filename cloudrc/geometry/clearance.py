"""How near the robot is to the pipes: poses go in, distances to the nearest wall come out.

A pipe is taken as the ideal hollow cylinder with flat ends, not as the staves that the physics
collides with: those deviate by up to 3.2 mm.

Source: docs/reference/plant.md, "Staves".
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from cloudrc.geometry.robot import Array, Points, key_points, place
from cloudrc.geometry.scene import Pipe, Scene

_CHUNK = 100  # poses at a time: 100 x 225 points stay in the processor's cache


def distance_to_pipe(pipe: Pipe, points: Array) -> Array:
    """Measure the signed distance of points to a pipe's material.

    Around the axis a hollow cylinder is a rectangle in the plane of s, along the axis, and r,
    away from it; the distance is the one to that rectangle.

    Args:
        pipe: The hollow cylinder.
        points: [m], world frame, shape (..., 3).

    Returns:
        Distance [m], shape (...): positive outside of the material, in the bore too; negative in
        the wall.
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
    points: Points | None = None,
) -> Array:
    """Measure how far the robot is from each pipe.

    Args:
        scene: Where it flies.
        positions: Of the base [m], world frame, shape (n, 3).
        orientations_wxyz: Of the base, unit quaternions, body to world, shape (n, 4).
        points: What of the robot counts; default: `key_points()`.

    Returns:
        Distance of the robot's nearest point to the material [m], shape (n, number of pipes).
    """
    points = points or key_points()
    at = np.asarray(positions, dtype=np.float64).reshape(-1, 3)
    facing = np.asarray(orientations_wxyz, dtype=np.float64).reshape(-1, 4)
    result = np.full((len(at), len(scene.pipes)), np.inf)
    for start in range(0, len(at) if scene.pipes else 0, _CHUNK):
        part = slice(start, start + _CHUNK)
        placed = place(points, at[part], facing[part])
        for index, pipe in enumerate(scene.pipes):
            distance = distance_to_pipe(pipe, placed) - points.radii
            result[part, index] = distance.min(axis=1)
    return result


def clearance(scene: Scene, positions: ArrayLike, orientations_wxyz: ArrayLike) -> Array:
    """Measure how far the robot is from the nearest pipe.

    Args:
        scene: Where it flies.
        positions: Of the base [m], world frame, shape (n, 3).
        orientations_wxyz: Of the base, unit quaternions, body to world, shape (n, 4).

    Returns:
        [m], shape (n,): negative where a point is in a wall, infinite in a scene without pipes.
    """
    nearest: Array = clearance_per_pipe(scene, positions, orientations_wxyz).min(
        axis=1, initial=np.inf
    )
    return nearest


def pipe_index(scene: Scene, positions: ArrayLike) -> NDArray[np.int64]:
    """Say in which pipe's bore the base is.

    Args:
        scene: Where it flies.
        positions: Of the base [m], world frame, shape (n, 3).

    Returns:
        Index of the pipe, the first of several; -1 where the base is in none; shape (n,).
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
    """Say whether the base is in a bore: |s| <= half the length, r < the inner radius.

    Args:
        scene: Where it flies.
        positions: Of the base [m], world frame, shape (n, 3).

    Returns:
        True where it is; shape (n,).
    """
    return pipe_index(scene, positions) >= 0
