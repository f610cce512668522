"""List the obstacles of a scene, declared tubes and plates and all others; find its fence."""

from __future__ import annotations

from dataclasses import replace
from importlib.util import find_spec
from typing import TypeAlias

import numpy as np

from cloudrc.errors import MissingPrerequisiteError
from cloudrc.geometry.fence import SPACE, Fence
from cloudrc.geometry.scene import FLOOR, WORLD, Plate, Scene, Tube, is_obstacle
from cloudrc.geometry.solids import Solid

Obstacle: TypeAlias = Tube | Solid
PLATE_DEPTH = 0.05
"""Thickness of a declared plate [m], as in the shipped scene `pipes`."""
_WORDS = {
    WORLD: "world, the geoms in the worldbody of the scene",
}
"""Name of a body -> words for messages; all other bodies have their names alone."""


def obstacles(scene: Scene, *, touch: str | None) -> tuple[Obstacle, ...]:
    """Return all obstacles of a scene: not the body `touch`, which the mission has to touch.

    Shapes that the scene declares as numbers are read without MuJoCo, all others with MuJoCo. If it
    is not installed, the others are missing.

    Raises:
        BadInputError: If MuJoCo cannot read the scene.
    """
    found: list[Obstacle] = [*scene.tubes, *map(_as_solid, scene.plates)]
    declared = {each.name for each in found}
    found += [solid for solid in _compiled(scene)[1] if solid.name not in declared]
    return tuple(each for each in found if is_obstacle(each.name, touch=touch))


def has_surface(obstacle: Obstacle) -> bool:
    """Return whether the surface of an obstacle is known, and not only the box around it."""
    return isinstance(obstacle, Tube) or obstacle.shape != "outline"


def surface(obstacle: Obstacle) -> str:
    """Return how messages name what the robot would touch."""
    if isinstance(obstacle, Tube):
        return f"the wall of {obstacle.name}"
    return _WORDS.get(obstacle.name, obstacle.name)


def body_names(scene: Scene) -> tuple[str, ...] | None:
    """Return the names of all bodies of a scene; None if they are not `known`."""
    if scene.path is None:
        tubes, plates = scene.tubes, scene.plates
        return (FLOOR, *(tube.name for tube in tubes), *(plate.name for plate in plates))
    return _compiled(scene)[0] or None


def bodies_inside(scene: Scene, body: str) -> tuple[str, ...]:
    """Return the bodies inside of a body that has no geoms of its own; none for all others."""
    if scene.path is None or not known(scene):
        return ()
    from cloudrc.geometry.compiled import read_bodies

    return read_bodies(scene.path).inner.get(body, ())


def intangible(scene: Scene) -> tuple[str, ...]:
    """Return the bodies that have geoms, and none that the robot can touch: no obstacles."""
    names, solids = _compiled(scene)
    if scene.path is None:
        return scene.intangible
    tangible = {solid.name for solid in solids}
    return tuple(name for name in names if name not in {FLOOR, *tangible})


def fence_of(scene: Scene) -> Fence:
    """Return the fence of a scene: the declared one, else the box around spawn and geoms.

    That box has `SPACE` around walls and ceiling, and ends below at the ground under the spawn.

    Raises:
        BadInputError: If MuJoCo cannot read the scene.
        MissingPrerequisiteError: If the scene declares no fence, and MuJoCo is missing.
    """
    if scene.own_fence is not None:
        return scene.own_fence
    if not known(scene):
        raise MissingPrerequisiteError(
            f"scene {scene.name}: has no fence, and the box around its geoms needs MuJoCo; add "
            '<numeric name="fence" data="x0 y0 z0 x1 y1 z1"/>, set world.fence_m, or run: '
            "pip install 'cloudrc[world]'"
        )
    low, high, ground = scene.spawn, scene.spawn, scene.floor
    if scene.path is not None:
        from cloudrc.geometry.compiled import read_bodies

        bodies = read_bodies(scene.path)
        (low, high), ground = bodies.extent, bodies.ground
    (ax, ay, _), (bx, by, bz) = low, high
    return Fence((ax - SPACE, ay - SPACE, ground), (bx + SPACE, by + SPACE, bz + SPACE))


def without_file(scene: Scene) -> Scene:
    """Return a scene with all its bodies and its fence, of which nothing has to be read again.

    Raises:
        BadInputError: If MuJoCo cannot read the scene.
    """
    solids, fence = _compiled(scene)[1], fence_of(scene)
    flown_through = intangible(scene)
    return replace(scene, path=None, own_fence=fence, solids=solids, intangible=flown_through)


def known(scene: Scene) -> bool:
    """Return whether `obstacles` returns all obstacles of a scene."""
    return scene.path is None or find_spec("mujoco") is not None


def _compiled(scene: Scene) -> tuple[tuple[str, ...], tuple[Solid, ...]]:
    if scene.path is None or not known(scene):
        return (), scene.solids
    from cloudrc.geometry.compiled import read_bodies

    bodies = read_bodies(scene.path)
    return bodies.names, bodies.solids


def _as_solid(plate: Plate) -> Solid:
    spans = np.array([(plate.x, plate.x + PLATE_DEPTH), plate.y, plate.z])
    half = (spans[:, 1] - spans[:, 0]) / 2
    return Solid(
        plate.name, "box", spans.mean(axis=1), np.eye(3), half, float(np.linalg.norm(half))
    )
