# SPDX-License-Identifier: Apache-2.0

"""Read the tubes, the plates and the floor of a scene from its MJCF file, without MuJoCo.

For this reader, the MJCF file repeats the ideal shapes as numbers: `<custom><numeric name="..."
data="..."/>`, in metres, world frame. The name of a tube or plate is that of its body.

| name | data |
|---|---|
| a body | 9 numbers, a tube: centre x y z, axis x y z, length, inner radius, outer radius |
| a body | 5 numbers, a plate: x of the front face, smallest and largest y, smallest and largest z |
| `floor` | z; 0 if the file has no `floor` |
| `fence` | corner with the smallest x y z, corner with the largest |
| a body with `_path` | points x y z, two or more, along which it moves round and round |
| a body with `_speed` | its speed [m/s] |
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from xml.etree import ElementTree

import numpy as np

from cloudrc.base.outside.values import InvalidValueError
from cloudrc.physics.geometry.fence import Corners, Fence, order_of
from cloudrc.physics.geometry.moving import Moving
from cloudrc.physics.geometry.solids import Array, Solid
from cloudrc.wire.messages import Vector

SPAWN: Vector = (0.0, 0.0, 0.1)
"""Position of the base at the start of a mission in the shipped scenes [m], world frame."""
FLOOR, WORLD = "floor", "world"
"""Names of the body on which the robot stands, and of all geoms in a scene's worldbody."""
FENCE = "fence"
"""Name of the numbers that declare the scene's fence."""
SCENES = Path(__file__).parents[2] / "world" / "scenes"


@dataclass(frozen=True, slots=True)
class Tube:
    """A hollow cylinder with flat ends."""

    name: str  # of the body
    centre: Vector  # midpoint of the axis [m], world frame
    axis: Vector  # unit vector along the axis, world frame
    length: float  # [m]
    inner: float  # inner radius [m]
    outer: float  # outer radius [m]

    def distance(self, points: Array) -> Array:
        """Compute the distance of points from the wall [m], shape (...); negative inside the wall.

        `points` are in [m], world frame, shape (..., 3). With s the position along the axis and r
        the distance from the axis, the wall is a rectangle in the (s, r) plane.
        """
        relative = points - np.asarray(self.centre)
        s = relative @ np.asarray(self.axis)
        r_squared = np.einsum("...i,...i->...", relative, relative) - s * s
        r = np.sqrt(np.maximum(r_squared, 0.0))
        beyond_end = np.abs(s) - 0.5 * self.length
        beyond_face = np.abs(r - 0.5 * (self.inner + self.outer)) - 0.5 * (self.outer - self.inner)
        nearest: Array = np.minimum(np.maximum(beyond_end, beyond_face), 0.0)
        np.maximum(beyond_end, 0.0, out=beyond_end)
        np.maximum(beyond_face, 0.0, out=beyond_face)
        nearest += np.sqrt(beyond_end * beyond_end + beyond_face * beyond_face)
        return nearest


@dataclass(frozen=True, slots=True)
class Plate:
    """A thin upright wall; the front face points along -x."""

    name: str  # of the body
    x: float  # position of the front face [m], world frame
    y: tuple[float, float]  # smallest and largest y [m], world frame
    z: tuple[float, float]  # smallest and largest z [m], world frame


@dataclass(frozen=True, slots=True)
class Scene:
    """A scene as numbers: what its file declares, and what MuJoCo has read of its other bodies."""

    name: str  # file name without .xml
    tubes: tuple[Tube, ...] = ()  # in the order of the file
    plates: tuple[Plate, ...] = ()  # in the order of the file
    floor: float = 0.0  # z of the floor [m], world frame
    spawn: Vector = SPAWN  # position of the base at the start of a mission [m], world frame
    path: Path | None = None  # of the file if it has bodies that are still to be read; else None
    own_fence: Fence | None = None  # declared, or the box around spawn and geoms; None: not known
    solids: tuple[Solid, ...] = ()  # all that the robot can touch, without the floor
    bodies: tuple[str, ...] = ()  # names of all bodies with geoms
    intangible: tuple[str, ...] = ()  # names of those that the robot flies through
    moving: tuple[Moving, ...] = ()  # bodies that move


def is_obstacle(body: str, *, touch: str | None) -> bool:
    """Return whether the robot must not touch a body, given by its name.

    Every body is an obstacle but the floor and the body `touch`, which the mission has to touch.
    """
    return body not in (FLOOR, touch)


def load_scene(name: str, corners: Corners | None = None) -> Scene:
    """Read a scene by the path of an .xml file, or a shipped scene by its file name without .xml.

    `corners` [m] replace those of the scene's fence. Raise an InvalidValueError if the file does
    not exist, or if its numbers do not have the form in the table at the top of this module.
    """
    is_shipped = not name.endswith(".xml")
    path = SCENES / f"{name}.xml" if is_shipped else Path(name)
    try:
        scene = _read(_parse(path), path, is_shipped=is_shipped)
    except (OSError, ElementTree.ParseError, ValueError) as error:
        raise InvalidValueError(f"scene {path.name}: {error}") from error
    return replace(scene, own_fence=Fence(*corners)) if corners else scene


def _parse(path: Path) -> ElementTree.Element:
    """Read an MJCF file; each `<include>` has become the content of its file, as in MuJoCo.

    A file that is missing or included twice is left out: MuJoCo says why it is wrong.
    """
    root, known = ElementTree.parse(path).getroot(), {path}

    def expand(element: ElementTree.Element, folder: Path) -> None:
        children = list[ElementTree.Element]()
        for child in element:
            if child.tag != "include":
                expand(child, folder)
                children.append(child)
                continue
            # Where MuJoCo looks depends on its version.
            places = [each / child.get("file", "") for each in (folder, path.parent)]
            file = next((each for each in places if each.is_file()), path)
            if file not in known:
                known.add(file)
                content = ElementTree.parse(file).getroot()
                expand(content, file.parent)
                children += content
        element[:] = children

    expand(root, path.parent)
    return root


def _read(root: ElementTree.Element, path: Path, *, is_shipped: bool) -> Scene:
    """Read the scene in the file `path`, whose element is `root`."""
    numerics = {n.get("name", ""): n.get("data", "") for n in root.iterfind("custom/numeric")}
    names = {body.get("name") for body in root.iter("body")} - {FLOOR, FENCE}
    shapes = [_shape(name, data) for name, data in numerics.items() if name in names]
    frame = root.find("./worldbody/frame[@name='spawn']")
    spawn = SPAWN if frame is None else _numbers("spawn", frame.get("pos", "0 0 0"), 3)
    bodies = {body.get("name") for body in root.iterfind("worldbody/body")}
    is_complete = is_shipped and bodies <= {FLOOR, *numerics}
    return Scene(
        path.stem,
        tuple(shape for shape in shapes if isinstance(shape, Tube)),
        tuple(shape for shape in shapes if isinstance(shape, Plate)),
        _numbers(FLOOR, numerics.get(FLOOR, "0"), 1)[0],
        (spawn[0], spawn[1], spawn[2]),
        None if is_complete else path,
        _fence(_numbers(FENCE, numerics[FENCE], 6)) if FENCE in numerics else None,
        bodies=(FLOOR, *(shape.name for shape in shapes)),
        moving=tuple(_moving(root, numerics)),
    )


def _moving(root: ElementTree.Element, numerics: dict[str, str]) -> Iterator[Moving]:
    for body in root.iter("body"):
        name = body.get("name", "")
        path, speed = (f"{name}_{what}" for what in ("path", "speed"))
        if path not in numerics:
            continue
        if body.get("mocap") != "true":
            raise ValueError(f'{name}: has the numbers {path}, so it needs mocap="true"')
        words = numerics[path].split()
        flat = _numbers(path, numerics[path], max(len(words) // 3, 2) * 3)
        (pace,) = _numbers(speed, numerics.get(speed, ""), 1)
        if pace <= 0:
            raise ValueError(f"{speed}: data must be a speed above 0 [m/s]: {numerics[speed]!r}")
        if _numbers(name, body.get("pos", "0 0 0"), 3) != flat[:3]:
            raise ValueError(f"{name}: its pos must be the first point of {path}")
        yield Moving(name, tuple(zip(flat[::3], flat[1::3], flat[2::3], strict=True)), pace)


def _fence(numbers: list[float]) -> Fence:
    ax, ay, az, bx, by, bz = numbers
    fence = Fence((ax, ay, az), (bx, by, bz))
    if wrong := order_of((fence.low, fence.high)):
        raise ValueError(f"fence: {wrong}")
    return fence


def _shape(name: str, data: str) -> Tube | Plate:
    count = len(data.split())
    if count not in (5, 9):
        raise ValueError(f"{name}: data must be 9 numbers (a tube) or 5 (a plate): {data!r}")
    if count == 5:
        x, y_min, y_max, z_min, z_max = _numbers(name, data, 5)
        return Plate(name, x, (y_min, y_max), (z_min, z_max))
    cx, cy, cz, ax, ay, az, length, inner, outer = _numbers(name, data, 9)
    norm = math.hypot(ax, ay, az)
    if norm == 0 or length <= 0 or not 0 < inner < outer:
        raise ValueError(
            f"{name}: needs an axis that is not zero, a length above 0 and 0 < inner < outer radius"
        )
    return Tube(name, (cx, cy, cz), (ax / norm, ay / norm, az / norm), length, inner, outer)


def _numbers(name: str, data: str, count: int) -> list[float]:
    try:
        numbers = [float(word) for word in data.split()]
    except ValueError:
        numbers = []
    if len(numbers) != count or not all(map(math.isfinite, numbers)):
        raise ValueError(f"{name}: data must be {count} numbers: {data!r}")
    return numbers
