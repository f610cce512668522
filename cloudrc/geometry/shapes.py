"""Describe what robot and scene look like: surfaces of flat convex polygons, with colours.

The recording of a flight has these shapes in the attachment `shapes.npz`, so that the flight can be
drawn without MuJoCo, and without the user's files of robot and scene.
"""

from __future__ import annotations

import zlib
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from io import BytesIO
from typing import Any, TypeAlias
from zipfile import BadZipFile

import numpy as np
from numpy.typing import NDArray

from cloudrc.errors import BadInputError

Array: TypeAlias = NDArray[np.float64]
Rgba: TypeAlias = tuple[float, float, float, float]

SHAPES_FILE = "shapes.npz"
"""Name of the attachment of a recording."""
_UNREADABLE = ValueError, KeyError, IndexError, OSError, EOFError, BadZipFile, zlib.error
"""What reading a damaged attachment raises."""
SIDES = 20
"""Number of corners of a circle; a multiple of 4."""


@dataclass(frozen=True, eq=False, slots=True)
class Surface:
    """The surface of a part of a body, in one colour.

    Each array of `faces` has the shape (m, k): m flat convex polygons, each with k corners, which
    are rows of `corners`.
    """

    body: str  # name in the scene; "" for the robot
    corners: Array  # [m], shape (n, 3); frame of the base for the robot, else world frame
    faces: tuple[NDArray[np.int32], ...]
    rgba: Rgba = (0.5, 0.5, 0.5, 1.0)  # red, green, blue, opacity in [0, 1]
    # Whether it is the whole surface of a convex body, with the corners of each face
    # counter-clockwise for a viewer outside.
    convex: bool = False

    @property
    def triangles(self) -> NDArray[np.int32]:
        """The faces as triangles, shape (m, 3)."""
        parts = [
            faces[:, [0, n, n + 1]] for faces in self.faces for n in range(1, faces.shape[1] - 1)
        ]
        return np.concatenate(parts) if parts else np.zeros((0, 3), np.int32)

    def placed(self, position: Any, axes: Any) -> Surface:
        """Return the surface at a pose.

        `position` is that of its origin [m], shape (3,). The columns of `axes` are its unit vectors
        along x, y and z [1], shape (3, 3).
        """
        return replace(self, corners=self.corners @ np.transpose(axes) + position)


@dataclass(frozen=True, eq=False, slots=True)
class Shapes:
    """What is to be drawn of a robot and its scene."""

    robot: tuple[Surface, ...] = ()  # at rest, in the frame of its base
    scene: tuple[Surface, ...] = ()  # without infinite planes
    planar: bool = False  # whether the robot stays on the ground

    @property
    def size(self) -> float:
        """Diameter of the smallest ball around the robot's base that holds the robot [m]."""
        points = [surface.corners for surface in self.robot]
        if not points:
            return 0.0
        return 2 * float(np.linalg.norm(np.concatenate(points), axis=1).max())

    def to_bytes(self) -> bytes:
        """Return the content of a file, which `from_bytes` reads; equal shapes give equal bytes."""
        surfaces = [*self.robot, *self.scene]
        faces = [each for surface in surfaces for each in surface.faces]
        file = BytesIO()
        np.savez_compressed(
            file,
            planar=np.array(self.planar),
            bodies=np.array([surface.body for surface in surfaces], dtype=np.str_),
            rgba=np.array([surface.rgba for surface in surfaces], np.float32).reshape(-1, 4),
            convex=np.array([surface.convex for surface in surfaces], bool),
            sizes=np.array([(len(each.corners), len(each.faces)) for each in surfaces], np.int32),
            corners=_joined((each.corners for each in surfaces), np.float32),
            faces=np.array([each.shape for each in faces], np.int32).reshape(-1, 2),
            indices=_joined((each.ravel() for each in faces), np.int32),
        )
        return file.getvalue()

    @staticmethod
    def from_bytes(data: bytes) -> Shapes:
        """Read shapes from the content of a file; raise a BadInputError if it is not readable."""
        try:
            with np.load(BytesIO(data), allow_pickle=False) as file:
                return _read({name: file[name] for name in file.files})
        except _UNREADABLE as error:
            raise BadInputError(f"{SHAPES_FILE} is not readable") from error


def _joined(parts: Iterable[Any], dtype: Any) -> NDArray[Any]:
    """Concatenate arrays; the result of none is an empty array."""
    found = list(parts)
    return np.concatenate(found).astype(dtype) if found else np.zeros(0, dtype)


def _read(file: dict[str, NDArray[Any]]) -> Shapes:
    corners = file["corners"].astype(float).reshape(-1, 3)
    blocks = _split(file["indices"], file["faces"].astype(int).prod(axis=1))
    polygons = [each.reshape(shape) for each, shape in zip(blocks, file["faces"], strict=True)]
    points = _split(corners, file["sizes"].reshape(-1, 2)[:, 0])
    found, first = [], 0
    for n, body in enumerate(file["bodies"]):
        last = first + int(file["sizes"][n, 1])
        faces, first = tuple(polygons[first:last]), last
        if any(((each < 0) | (each >= len(points[n]))).any() for each in faces):
            raise ValueError("a face has a corner that does not exist")
        r, g, b, opacity = np.clip(file["rgba"][n], 0.0, 1.0).tolist()
        rgba, convex = (r, g, b, opacity), bool(file["convex"][n])
        found.append(Surface(str(body), points[n], faces, rgba, convex))
    robot = tuple(surface for surface in found if not surface.body)
    scene = tuple(surface for surface in found if surface.body)
    return Shapes(robot, scene, bool(file["planar"]))


def _split(array: NDArray[Any], lengths: Any) -> list[NDArray[Any]]:
    """Split an array into parts of the given lengths."""
    if int(np.sum(lengths)) != len(array) or np.min(lengths, initial=0) < 0:
        raise ValueError("the parts have other lengths than the whole")
    return np.split(array, np.cumsum(lengths)[:-1]) if len(lengths) else []


def box(half: Any) -> Surface:
    """Return a box with the half edges `half` [m], shape (3,), around the origin."""
    signs = np.array([(x, y, z) for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)], float)
    faces = [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)]
    return Surface("", signs * half, (np.array(faces, np.int32),), convex=True)


def cylinder(radius: float, half: float) -> Surface:
    """Return a cylinder of a radius [m] and half a length [m] along z, around the origin."""
    angle = np.arange(SIDES) * (2 * np.pi / SIDES)
    ring = radius * np.stack([np.cos(angle), np.sin(angle), np.zeros(SIDES)], axis=1)
    up = np.array([0.0, 0.0, half])
    corners = np.concatenate([ring - up, ring + up])
    here = np.arange(SIDES, dtype=np.int32)
    ends = np.stack([here[::-1], here + SIDES])
    return Surface("", corners, (_bands(2, SIDES), ends), convex=True)


def globe(half: Any, stretch: float = 0.0) -> Surface:
    """Return an ellipsoid with the half axes `half` [m], shape (3,), around the origin.

    Its upper half is moved up, and its lower half down, by `stretch` [m]. With equal half axes the
    result is a sphere or a capsule.
    """
    sides = SIDES if stretch <= 2 * half[2] else 8  # the ends of a rod are small
    height = np.linspace(-np.pi / 2, np.pi / 2, sides // 2 + 1)
    lower, upper = height[1 : sides // 4 + 1], height[sides // 4 + (not stretch) : -1]
    height = np.concatenate([lower, upper])
    angle = np.arange(sides) * (2 * np.pi / sides)
    corners = np.stack(
        [
            np.cos(height)[:, None] * np.cos(angle) * half[0],
            np.cos(height)[:, None] * np.sin(angle) * half[1],
            np.repeat(np.sin(height)[:, None] * half[2], sides, axis=1),
        ],
        axis=2,
    )
    corners[: len(lower), :, 2] -= stretch
    corners[len(lower) :, :, 2] += stretch
    ends = np.array([(0, 0, -1), (0, 0, 1)]) * (half[2] + stretch)
    corners = np.concatenate([corners.reshape(-1, 3), ends])
    here, last = np.arange(sides, dtype=np.int32), len(corners) - 2
    there, top = np.roll(here, -1), last - sides
    below = np.stack([there, here, np.full_like(here, last)], axis=1)
    above = np.stack([here + top, there + top, np.full_like(here, last + 1)], axis=1)
    faces = _bands(len(height), sides), np.concatenate([below, above])
    return Surface("", corners, faces, convex=True)


def _bands(rings: int, sides: int) -> NDArray[np.int32]:
    """Return the quadrangles between neighbouring rings of `sides` corners, the lowest first."""
    here = np.arange(sides, dtype=np.int32)
    band = np.stack([here, np.roll(here, -1), np.roll(here, -1) + sides, here + sides], axis=1)
    return np.concatenate([band + ring * sides for ring in range(rings - 1)])


def sheet(half_x: float, half_y: float) -> Surface:
    """Return a rectangle in the plane z = 0; `half_x` and `half_y` are half its edges [m]."""
    corners = np.array([(-1, -1, 0), (1, -1, 0), (1, 1, 0), (-1, 1, 0)]) * (half_x, half_y, 1.0)
    return Surface("", corners, (np.array([(0, 1, 2, 3)], np.int32),))


def terrain(heights: Array, half_x: float, half_y: float, base: float) -> Surface:
    """Return the ground of a height field around the origin, on a block.

    `heights` are in [m], shape (rows, columns), rows along y. `half_x` and `half_y` are half the
    edges [m], the bottom of the block is at z = -`base` [m].
    """
    rows, columns = heights.shape
    x, y = np.linspace(-half_x, half_x, columns), np.linspace(-half_y, half_y, rows)
    ground = np.stack([*np.meshgrid(x, y), heights], axis=2).reshape(-1, 3)
    cell = np.arange(len(ground), dtype=np.int32).reshape(rows, columns)
    quads = [cell[:-1, :-1], cell[:-1, 1:], cell[1:, 1:], cell[1:, :-1]]
    a, b, c, d = (each.ravel() for each in quads)  # not flat: two triangles each
    triangles = np.concatenate([np.stack([a, b, c], axis=1), np.stack([a, c, d], axis=1)])
    rim = np.concatenate([cell[0], cell[1:, -1], cell[-1, -2::-1], cell[-2:0:-1, 0]])
    foot = ground[rim] * (1, 1, 0) - (0, 0, base)
    below = np.arange(len(rim), dtype=np.int32) + len(ground)
    walls = np.stack([below, np.roll(below, -1), np.roll(rim, -1), rim], axis=1)
    return Surface("", np.concatenate([ground, foot]), (triangles, walls.astype(np.int32)))


def rotation(wxyz: Any) -> Array:
    """Return the rotation matrix of a unit quaternion, shape (3, 3)."""
    w, x, y, z = wxyz
    return np.array(
        [
            (1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)),
            (2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)),
            (2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)),
        ]
    )


def merged(surfaces: Sequence[Surface]) -> tuple[Array, NDArray[np.int32]]:
    """Join surfaces: return corners [m], shape (n, 3), and triangles, shape (m, 3)."""
    firsts = np.cumsum([0, *(len(each.corners) for each in surfaces)])
    triangles = [each.triangles + first for each, first in zip(surfaces, firsts, strict=False)]
    return np.concatenate([each.corners for each in surfaces]), np.concatenate(triangles)
