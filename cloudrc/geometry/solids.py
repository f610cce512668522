"""Convex bodies, and the distance of points from them."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, TypeAlias, get_args

import numpy as np
from numpy.typing import NDArray

Array: TypeAlias = NDArray[np.float64]
Shape: TypeAlias = Literal[
    "box", "sphere", "capsule", "cylinder", "ellipsoid", "plane", "hull", "outline"
]


@dataclass(frozen=True, eq=False, slots=True)
class Solid:
    """A convex body, or the space below a plane.

    `size` is half the edges of a box, or of an outline, the box around a shape that is not convex,
    such as a height field; the radius of a sphere; the radius, and half the length of
    the axis of a capsule (without its ends) or cylinder; the half-axes of an ellipsoid. The axis of
    a capsule or cylinder and the normal of a plane are along z.
    """

    name: str  # of the body in the scene
    shape: Shape
    centre: Array  # [m], world frame, shape (3,)
    axes: Array  # columns: unit vectors along its x, y and z [1], world frame, shape (3, 3)
    size: Array  # [m], shape (3,); without meaning for planes and hulls
    radius: float  # of a ball around `centre` that contains the solid [m]
    faces: tuple[Array, Array] | None = None  # of a hull: normals (m, 3), offsets (m,) [m]

    def distance(self, points: Array) -> Array:
        """Compute the distance of points from the surface [m], shape (...); negative inside.

        `points` are in [m], world frame, shape (..., 3). Near the edges of a hull, and near an
        ellipsoid, the true distance is larger.
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


def _to_ellipsoid(solid: Solid, local: Array) -> Array:
    scaled = np.linalg.norm(local / solid.size, axis=-1)
    distance: Array = (scaled - 1.0) * solid.size.min()
    return distance


def _to_plane(solid: Solid, local: Array) -> Array:
    height: Array = local[..., 2]
    return height


def _to_hull(solid: Solid, local: Array) -> Array:
    assert solid.faces is not None
    normals, offsets = solid.faces
    distance: Array = (local @ normals.T - offsets).max(axis=-1)
    return distance


SHAPES = get_args(Shape)
"""The shapes that a solid may have."""
_DISTANCES = {
    "box": _to_box,
    "sphere": _to_sphere,
    "capsule": _to_capsule,
    "cylinder": _to_cylinder,
    "ellipsoid": _to_ellipsoid,
    "plane": _to_plane,
    "hull": _to_hull,
    "outline": _to_box,
}
