# SPDX-License-Identifier: Apache-2.0

"""Describe what robot and scene look like: surfaces of triangles, with colours.

The recording of a flight has these shapes in the attachment `shapes.npz`, so that the flight can be
drawn without MuJoCo, and without the user's files of robot and scene.
"""

from __future__ import annotations

import zlib
from collections.abc import Sequence
from dataclasses import dataclass, replace
from io import BytesIO
from typing import Any, TypeAlias
from zipfile import BadZipFile

import numpy as np
from numpy.typing import NDArray

from cloudrc.base.outside.values import InvalidValueError
from cloudrc.wire.messages import Quaternion, Vector

Array: TypeAlias = NDArray[np.float64]
Rgba: TypeAlias = tuple[float, float, float, float]
Pose: TypeAlias = tuple[Vector, Quaternion]
"""Position [m] and orientation wxyz [1]."""

SHAPES_FILE = "shapes.npz"
"""Name of the attachment of a recording."""
_UNREADABLE = (
    *(ValueError, TypeError, KeyError, IndexError, AttributeError),
    *(OSError, EOFError, BadZipFile, zlib.error),
)
"""What reading a damaged attachment raises."""
SENSORS = ("scanner", "camera")
"""Sensors of a robot whose poses belong to its shapes."""
SIDES = 20
"""Number of corners of a circle; a multiple of 4."""


@dataclass(frozen=True, eq=False, slots=True)
class Surface:
    """The surface of a part of a body, in one colour."""

    body: str  # name in the scene; "" for the robot
    corners: Array  # [m], shape (n, 3); frame of the base for the robot, else world frame
    triangles: NDArray[np.int32]  # rows of `corners`, shape (m, 3)
    rgba: Rgba = (0.5, 0.5, 0.5, 1.0)  # red, green, blue, opacity in [0, 1]
    # Whether it is the whole surface of a convex body, with the corners of each triangle
    # counter-clockwise for a viewer outside.
    convex: bool = False

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
    scanner: Pose | None = None  # of the robot's scanner, in the frame of the base
    camera: Pose | None = None  # of its camera, likewise: x to the right, y down, z ahead

    @staticmethod
    def of(surfaces: Sequence[Surface], planar: bool) -> Shapes:
        """Sort surfaces by their bodies; `planar` is whether the robot stays on the ground."""
        robot = tuple(surface for surface in surfaces if not surface.body)
        return Shapes(robot, tuple(surface for surface in surfaces if surface.body), planar)

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
        file, more = BytesIO(), dict[str, Any]()
        for name in SENSORS:
            if pose := getattr(self, name):  # robots without one keep their bytes
                more[name] = np.array([*pose[0], *pose[1]])
        np.savez_compressed(
            file,
            **more,
            planar=np.array(self.planar),
            bodies=np.array([surface.body for surface in surfaces], dtype=np.str_),
            rgba=np.array([surface.rgba for surface in surfaces], np.float32).reshape(-1, 4),
            convex=np.array([surface.convex for surface in surfaces], bool),
            sizes=np.array([(len(each.corners), 1) for each in surfaces], np.int32),
            corners=np.concatenate(
                [np.zeros((0, 3)), *(each.corners for each in surfaces)], dtype=np.float32
            ),
            faces=np.array([each.triangles.shape for each in surfaces], np.int32).reshape(-1, 2),
            indices=np.concatenate(
                [np.zeros(0, np.int32), *(each.triangles.ravel() for each in surfaces)]
            ),
        )
        return file.getvalue()

    @staticmethod
    def from_bytes(data: bytes) -> Shapes:
        """Read shapes from the content of a file; may raise an InvalidValueError."""
        try:
            with np.load(BytesIO(data), allow_pickle=False) as file:
                return _read({name: file[name] for name in file.files})
        except _UNREADABLE as error:
            raise InvalidValueError(f"{SHAPES_FILE} is not readable") from error


def _read(file: dict[str, NDArray[Any]]) -> Shapes:
    counts = file["sizes"].reshape(-1, 2)[:, 0]
    points = np.split(file["corners"].astype(float), np.cumsum(counts)[:-1])
    triangles = np.split(file["indices"].reshape(-1, 3), np.cumsum(file["faces"][:, 0])[:-1])
    colours = np.clip(file["rgba"], 0.0, 1.0).tolist()
    found = [
        Surface(str(body), corners, faces, tuple(rgba), bool(convex))
        for body, corners, faces, rgba, convex in zip(
            file["bodies"], points, triangles, colours, file["convex"], strict=False
        )
    ]
    shapes = Shapes.of(found, bool(file["planar"]))
    poses = dict[str, Pose]()
    for name in SENSORS:
        if name in file:
            x, y, z, a, b, c, d = file[name].astype(float).tolist()
            poses[name] = (x, y, z), (a, b, c, d)
    return replace(shapes, scanner=poses.get("scanner"), camera=poses.get("camera"))


def _fan(polygons: NDArray[np.int32]) -> NDArray[np.int32]:
    """Divide convex polygons, shape (m, k), into triangles, shape (m (k - 2), 3)."""
    return np.concatenate([polygons[:, [0, n, n + 1]] for n in range(1, polygons.shape[1] - 1)])


def lathe(
    profile: Sequence[tuple[float, float]],
    sides: int = SIDES,
    *,
    first: float = 0.0,
    convex: bool = False,
) -> Surface:
    """Return what a line makes that turns about the z axis.

    `profile` has the points of the line: distance from the axis and height [m], shape (n, 2). With
    rising heights, the triangles are counter-clockwise for a viewer outside. `first` is the
    direction of the first of the `sides` corners of a circle [rad].
    """
    angle = first + np.arange(sides) * (2 * np.pi / sides)
    circle = np.stack([np.cos(angle), np.sin(angle), np.ones(sides)], axis=1)
    corners = np.concatenate([circle * (radius, radius, z) for radius, z in profile])
    here = np.arange(sides, dtype=np.int32)
    there = np.roll(here, -1)
    band = np.stack([here, there, there + sides, here + sides], axis=1)
    bands = [band + ring * sides for ring in range(len(profile) - 1)]
    return Surface("", corners, _fan(np.concatenate(bands)), convex=convex)


def box(half: Any) -> Surface:
    """Return a box with the half edges `half` [m], shape (3,), around the origin."""
    edge, corner = np.sqrt(2.0), np.pi / 4
    profile = [(0.0, -1.0), (edge, -1.0), (edge, 1.0), (0.0, 1.0)]
    cube = lathe(profile, 4, first=corner, convex=True)
    return replace(cube, corners=cube.corners * half)


def cylinder(radius: float, half: float) -> Surface:
    """Return a cylinder of a radius [m] and half a length [m] along z, around the origin."""
    return lathe([(0.0, -half), (radius, -half), (radius, half), (0.0, half)], convex=True)


def globe(half: Any, stretch: float = 0.0) -> Surface:
    """Return an ellipsoid with the half axes `half` [m], shape (3,), around the origin.

    Its upper half is moved up, and its lower half down, by `stretch` [m]. With equal half axes the
    result is a sphere or a capsule.
    """
    heights = np.linspace(-np.pi / 2, np.pi / 2, SIDES // 2 + 1)
    middle = len(heights) // 2 + 1
    profile = [(np.cos(height), np.sin(height)) for height in heights]
    ball = lathe([*profile[:middle], *profile[middle - 1 :]], convex=True)
    shift = np.repeat([-stretch, stretch], middle * SIDES)
    return replace(ball, corners=ball.corners * half + shift[:, None] * (0.0, 0.0, 1.0))


def sheet(half_x: float, half_y: float) -> Surface:
    """Return a rectangle in the plane z = 0; `half_x` and `half_y` are half its edges [m]."""
    corners = np.array([(-1, -1, 0), (1, -1, 0), (1, 1, 0), (-1, 1, 0)]) * (half_x, half_y, 1.0)
    return Surface("", corners, _fan(np.array([(0, 1, 2, 3)], np.int32)))


def terrain(heights: Array, half_x: float, half_y: float, base: float) -> Surface:
    """Return the ground of a height field around the origin, on a block.

    `heights` are in [m], shape (rows, columns), rows along y. `half_x` and `half_y` are half the
    edges [m], the bottom of the block is at z = -`base` [m].
    """
    # The walls are steep ground: the border once more, at the height of the bottom.
    heights = np.pad(heights, 1, constant_values=-base)
    rows, columns = heights.shape
    x, y = (
        np.pad(np.linspace(-half, half, count - 2), 1, "edge")
        for half, count in ((half_x, columns), (half_y, rows))
    )
    ground = np.stack([*np.meshgrid(x, y), heights], axis=2).reshape(-1, 3)
    cell = np.arange(len(ground), dtype=np.int32).reshape(rows, columns)
    quads = [cell[:-1, :-1], cell[:-1, 1:], cell[1:, 1:], cell[1:, :-1]]
    return Surface("", ground, _fan(np.stack([each.ravel() for each in quads], axis=1)))


def merged(surfaces: Sequence[Surface]) -> tuple[Array, NDArray[np.int32]]:
    """Join surfaces: return corners [m], shape (n, 3), and triangles, shape (m, 3)."""
    firsts = np.cumsum([0, *(len(each.corners) for each in surfaces)])
    triangles = [each.triangles + first for each, first in zip(surfaces, firsts, strict=False)]
    return np.concatenate([each.corners for each in surfaces]), np.concatenate(triangles)
