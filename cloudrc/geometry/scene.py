"""The scene in numbers: a scene's MJCF file goes in, its pipes, board and floor come out.

The bodies are MuJoCo's; their ideal shapes stand in the same file as numbers that no physics
engine is needed to read: `<custom><numeric name="pipe_1" data="..."/>`, in metres, world frame.

| name | data |
|---|---|
| `pipe_*` | centre x y z, axis x y z, length, inner radius, outer radius |
| `board` | x of the front face, y from, y to, z from, z to |
| `floor` | z; 0 where it is absent |
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path
from xml.etree import ElementTree

from cloudrc.errors import BadInputError
from cloudrc.messages import Vector

SCENES = Path(__file__).parents[1] / "world" / "scenes"


@dataclass(frozen=True, slots=True)
class Pipe:
    """A hollow cylinder with flat ends.

    Attributes:
        name: As the body is called.
        centre: Midpoint of the axis [m], world frame, shape (3,).
        axis: Unit vector along it, world frame, shape (3,).
        length: From end to end [m].
        inner: Radius of the bore [m].
        outer: Radius of the outside [m].
    """

    name: str
    centre: Vector
    axis: Vector
    length: float
    inner: float
    outer: float


@dataclass(frozen=True, slots=True)
class Board:
    """A wall to touch; its front face looks along -x.

    Attributes:
        x: Of the front face [m], world frame.
        y: From, to [m].
        z: From, to [m].
    """

    x: float
    y: tuple[float, float]
    z: tuple[float, float]


@dataclass(frozen=True, slots=True)
class Scene:
    """What a robot can run into.

    Attributes:
        name: File name without .xml.
        pipes: In the order of the file.
        board: None if there is none.
        floor: Its height z [m].
    """

    name: str
    pipes: tuple[Pipe, ...] = ()
    board: Board | None = None
    floor: float = 0.0


def load_scene(name: str) -> Scene:
    """Read a shipped scene by its file name without .xml.

    Raises:
        BadInputError: If there is no such file, or its numbers are not what the table above says.
    """
    return read_scene(SCENES / f"{name}.xml")


def read_scene(path: Path) -> Scene:
    """Read the scene in an MJCF file; raises as `load_scene`."""
    try:
        root = ElementTree.parse(path).getroot()
    except OSError as error:
        raise BadInputError(f"scene {path.name}: cannot be read: {error.strerror}") from error
    except ElementTree.ParseError as error:
        raise BadInputError(f"scene {path.name}: not readable as XML: {error}") from error
    pipes: list[Pipe] = []
    board, floor = None, 0.0
    for element in root.findall("./custom/numeric"):
        name = element.get("name", "")
        if name.startswith("pipe_"):
            pipes.append(_pipe(path, name, _numbers(path, element, 9)))
        elif name == "board":
            x, *spans = _numbers(path, element, 5)
            board = Board(x, (spans[0], spans[1]), (spans[2], spans[3]))
        elif name == "floor":
            (floor,) = _numbers(path, element, 1)
    return Scene(path.stem, tuple(pipes), board, floor)


def _pipe(path: Path, name: str, data: list[float]) -> Pipe:
    cx, cy, cz, ax, ay, az, length, inner, outer = data
    norm = math.hypot(ax, ay, az)
    if norm == 0 or length <= 0 or not 0 < inner < outer:
        raise BadInputError(
            f"scene {path.name}: {name}: needs an axis, a length and 0 < inner < outer radius"
        )
    return Pipe(name, (cx, cy, cz), (ax / norm, ay / norm, az / norm), length, inner, outer)


def _numbers(path: Path, element: ElementTree.Element, count: int) -> list[float]:
    text = element.get("data", "")
    try:
        numbers = [float(word) for word in text.split()]
    except ValueError:
        numbers = []
    if len(numbers) != count or not all(map(math.isfinite, numbers)):
        raise BadInputError(
            f"scene {path.name}: {element.get('name')}: data must be {count} numbers: {text!r}"
        )
    return numbers
