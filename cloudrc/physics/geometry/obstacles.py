# SPDX-License-Identifier: Apache-2.0

"""List the obstacles of a scene: declared tubes and plates, and all others."""

from __future__ import annotations

from dataclasses import replace
from typing import TypeAlias

import numpy as np

from cloudrc.base.errors import MissingPrerequisiteError
from cloudrc.physics.geometry.fence import Fence
from cloudrc.physics.geometry.scene import Plate, Scene, Tube, is_obstacle
from cloudrc.physics.geometry.solids import Solid

Obstacle: TypeAlias = Tube | Solid
PLATE_DEPTH = 0.05
"""Thickness of a declared plate [m], as in the shipped scene `pipes`."""


def obstacles(scene: Scene, *, touch: str | None) -> tuple[Obstacle, ...]:
    """Return all known obstacles of a scene: not the body `touch`, which the mission has to touch.

    A shape that the scene declares as numbers takes the place of the body's geoms.
    """
    found: list[Obstacle] = [*scene.tubes, *map(_as_solid, scene.plates)]
    declared = {each.name for each in found}
    found += [solid for solid in scene.solids if solid.name not in declared]
    return tuple(each for each in found if is_obstacle(each.name, touch=touch))


def has_surface(obstacle: Obstacle) -> bool:
    """Return whether the surface of an obstacle is known, and not only the box around it."""
    return isinstance(obstacle, Tube) or obstacle.shape != "outline"


def surface(obstacle: Obstacle) -> str:
    """Return how messages name what the robot would touch."""
    if isinstance(obstacle, Tube):
        return f"the wall of {obstacle.name}"
    return obstacle.name


def fence_of(scene: Scene, *, planar: bool = False) -> Fence:
    """Return the fence of a scene; a `planar` robot stays in it at the height of the spawn.

    Raises:
        MissingPrerequisiteError: If the scene declares no fence, and MuJoCo is missing.
    """
    if scene.own_fence is None:
        raise MissingPrerequisiteError(
            f"scene {scene.name}: has no fence, and the box around its geoms needs MuJoCo; add "
            '<numeric name="fence" data="x0 y0 z0 x1 y1 z1"/>, set world.fence_m, or run: '
            "pip install 'cloudrc[world]'"
        )
    return replace(scene.own_fence, ground=scene.spawn[2]) if planar else scene.own_fence


def _as_solid(plate: Plate) -> Solid:
    spans = np.array([(plate.x, plate.x + PLATE_DEPTH), plate.y, plate.z])
    half = (spans[:, 1] - spans[:, 0]) / 2
    return Solid(plate.name, "box", spans.mean(axis=1), np.eye(3), half)
