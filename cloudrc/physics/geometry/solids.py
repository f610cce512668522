# SPDX-License-Identifier: Apache-2.0

"""Convex bodies, and the distance of points from them."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, TypeAlias

import numpy as np
from numpy.typing import NDArray

Array: TypeAlias = NDArray[np.float64]
Shape: TypeAlias = Literal["box", "sphere", "capsule", "cylinder", "plane", "hull", "outline"]

_CELLS_MAX = 1 << 16
"""Largest number of pairs of points and faces, or edges, at a time: it bounds the memory."""
_ON_HULL = 1e-5
"""A point is on a hull if it is so little above the planes of its faces [m]: MuJoCo's corners are
float32."""


@dataclass(frozen=True, eq=False, slots=True)
class Solid:
    """A convex body, or the space below a plane.

    `size` is half the edges of a box, or of an outline, the box around any other shape, such as a
    height field; the radius of a sphere; the radius, and half the length of the axis of a capsule
    (without its ends) or cylinder. The axis of a capsule or cylinder and the normal of a plane are
    along z.
    """

    name: str  # of the body in the scene
    shape: Shape
    centre: Array  # [m], world frame, shape (3,)
    axes: Array  # columns: unit vectors along its x, y and z [1], world frame, shape (3, 3)
    size: Array  # [m], shape (3,); without meaning for planes and hulls
    # Of a hull: normals (m, 3) and offsets (m,) [m] of its faces, ends of its edges (k, 2, 3) [m].
    faces: tuple[Array, Array, Array] | None = None

    def distance(self, points: Array) -> Array:
        """Compute the distance of points from the surface [m], shape (...); negative inside.

        `points` are in [m], world frame, shape (..., 3).
        """
        local = (points - self.centre) @ self.axes
        return _DISTANCES[self.shape](self, local)


def _to_box(solid: Solid, local: Array) -> Array:
    beyond = np.abs(local) - solid.size
    outside: Array = np.linalg.norm(np.maximum(beyond, 0.0), axis=-1)
    outside += np.minimum(beyond.max(axis=-1), 0.0)
    return outside


def _to_sphere(solid: Solid, local: Array) -> Array:
    distance: Array = np.linalg.norm(local, axis=-1) - solid.size[0]
    return distance


def _to_capsule(solid: Solid, local: Array) -> Array:
    along = np.maximum(np.abs(local[..., 2]) - solid.size[1], 0.0)
    across = np.hypot(local[..., 0], local[..., 1])
    distance: Array = np.hypot(along, across) - solid.size[0]
    return distance


def _to_cylinder(solid: Solid, local: Array) -> Array:
    along = np.abs(local[..., 2]) - solid.size[1]
    across = np.hypot(local[..., 0], local[..., 1]) - solid.size[0]
    outside: Array = np.hypot(np.maximum(along, 0.0), np.maximum(across, 0.0))
    outside += np.minimum(np.maximum(along, across), 0.0)
    return outside


def _to_plane(solid: Solid, local: Array) -> Array:
    height: Array = local[..., 2]
    return height


def _to_hull(solid: Solid, local: Array) -> Array:
    """Compute the distance from the nearest face, or from the nearest edge.

    The largest distance from the planes of the faces is exact inside, and outside where the point
    of this plane below is on the hull. Elsewhere an edge, or its end, is nearest.
    """
    assert solid.faces is not None
    normals, offsets, edges = solid.faces
    points = local.reshape(-1, 3)
    distance = np.empty(len(points))
    rows = max(_CELLS_MAX // max(len(normals), len(edges)), 1)
    for start in range(0, len(points), rows):
        some = points[start : start + rows]
        heights = some @ normals.T - offsets
        highest = heights.argmax(axis=1)
        found = heights.max(axis=1)
        below = some - found[:, None] * normals[highest]
        beside = (found > 0.0) & ((below @ normals.T - offsets).max(axis=1) > _ON_HULL)
        found[beside] = _to_edges(edges, some[beside])
        distance[start : start + rows] = found
    return distance.reshape(local.shape[:-1])


def _to_edges(edges: Array, points: Array) -> Array:
    """Compute the distance of points (n, 3) from the nearest of the edges (k, 2, 3) [m]."""
    begins, along = edges[:, 0], edges[:, 1] - edges[:, 0]
    lengths = np.linalg.norm(along, axis=1)
    units = along / lengths[:, None]
    shares = points @ units.T - np.einsum("ij,ij->i", begins, units)
    from_begin = (points**2).sum(axis=1)[:, None] - 2.0 * points @ begins.T
    from_begin += (begins**2).sum(axis=1)
    nearest = np.clip(shares, 0.0, lengths)
    squares = from_begin - nearest * (2.0 * shares - nearest)
    distance: Array = np.sqrt(np.maximum(squares.min(axis=1), 0.0))
    return distance


_DISTANCES = {
    "box": _to_box,
    "sphere": _to_sphere,
    "capsule": _to_capsule,
    "cylinder": _to_cylinder,
    "plane": _to_plane,
    "hull": _to_hull,
    "outline": _to_box,
}
