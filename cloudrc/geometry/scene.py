"""Read the tubes, the plates and the floor of a scene from its MJCF file, without MuJoCo.

For this reader, the MJCF file repeats the ideal shapes as numbers: `<custom><numeric name="..."
data="..."/>`, in metres, world frame. The name of a tube or plate is that of its body.

| name | data |
|---|---|
| a body | 9 numbers, a tube: centre x y z, axis x y z, length, inner radius, outer radius |
| a body | 5 numbers, a plate: x of the front face, smallest and largest y, smallest and largest z |
| `floor` | z; 0 if the file has no `floor` |
| `fence` | corner with the smallest x y z, corner with the largest |
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path
from xml.etree import ElementTree

from cloudrc.errors import BadInputError
from cloudrc.geometry.fence import Corners, Fence, order_of
from cloudrc.messages import Vector

SPAWN: Vector = (0.0, 0.0, 0.1)
"""Position of the base at the start of a mission in the shipped scenes [m], world frame."""
FLOOR, WORLD = "floor", "world"
"""Names of the body on which the robot stands, and of all geoms in a scene's worldbody."""
SCENES = Path(__file__).parents[1] / "world" / "scenes"


@dataclass(frozen=True, slots=True)
class Tube:
    """A hollow cylinder with flat ends."""

    name: str  # of the body
    centre: Vector  # midpoint of the axis [m], world frame
    axis: Vector  # unit vector along the axis, world frame
    length: float  # [m]
    inner: float  # inner radius [m]
    outer: float  # outer radius [m]


@dataclass(frozen=True, slots=True)
class Plate:
    """A thin upright wall; the front face points along -x."""

    name: str  # of the body
    x: float  # position of the front face [m], world frame
    y: tuple[float, float]  # smallest and largest y [m], world frame
    z: tuple[float, float]  # smallest and largest z [m], world frame


@dataclass(frozen=True, slots=True)
class Scene:
    """The parts of a scene that its file declares as numbers."""

    name: str  # file name without .xml
    tubes: tuple[Tube, ...] = ()  # in the order of the file
    plates: tuple[Plate, ...] = ()  # in the order of the file
    floor: float = 0.0  # z of the floor [m], world frame
    spawn: Vector = SPAWN  # position of the base at the start of a mission [m], world frame
    path: Path | None = None  # of the file if it may have more bodies; None: this is all it has
    own_fence: Fence | None = None  # fence that is declared; None: see `obstacles.fence_of`


def is_obstacle(body: str, *, touch: str | None) -> bool:
    """Return whether the robot must not touch a body, given by its name.

    Every body is an obstacle but the floor and the body `touch`, which the mission has to touch.
    """
    return body not in (FLOOR, touch)


def load_scene(name: str, corners: Corners | None = None) -> Scene:
    """Read a scene by the path of an .xml file, or a shipped scene by its file name without .xml.

    `corners` [m] replace those of the scene's fence. Raise a BadInputError if the file does not
    exist, or if its numbers do not have the form in the table at the top of this module.
    """
    own = Path(name) if name.endswith(".xml") else None
    path = own or SCENES / f"{name}.xml"
    try:
        root = ElementTree.parse(path).getroot()
        numerics = [(n.get("name", ""), n.get("data", "")) for n in root.iterfind("custom/numeric")]
        names = {body.get("name") for body in root.iter("body")}
        shapes: list[Tube | Plate] = []
        floor, fence = 0.0, None
        for name, data in numerics:
            if name == FLOOR:
                (floor,) = _numbers(name, data, 1)
            elif name == "fence":
                fence = _fence(_numbers(name, data, 6))
            elif name in names:
                shapes.append(_shape(name, data))
        frame = root.find("./worldbody/frame[@name='spawn']")
        x, y, z = SPAWN if frame is None else _numbers("spawn", frame.get("pos", "0 0 0"), 3)
    except OSError as error:
        raise BadInputError(f"scene {path.name}: cannot be read: {error.strerror}") from error
    except ElementTree.ParseError as error:
        raise BadInputError(f"scene {path.name}: not readable as XML: {error}") from error
    except ValueError as error:
        raise BadInputError(f"scene {path.name}: {error}") from None
    bodies = {body.get("name") for body in root.iterfind("worldbody/body")}
    is_complete = own is None and bodies <= {FLOOR, *(name for name, _ in numerics)}
    own_fence = Fence(*corners) if corners else fence
    whole = None if is_complete else path
    tubes = tuple(shape for shape in shapes if isinstance(shape, Tube))
    plates = tuple(shape for shape in shapes if isinstance(shape, Plate))
    return Scene(path.stem, tubes, plates, floor, (x, y, z), whole, own_fence)


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
