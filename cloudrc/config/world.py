# SPDX-License-Identifier: Apache-2.0

"""The robot of an experiment and its scene: their files, read once, and what follows from them.

All that flies, measures or draws an experiment gets these objects from it. Nobody else looks for a
robot or a scene by its name.
"""

from __future__ import annotations

from collections.abc import Mapping
from functools import cached_property
from typing import Any, Self
from uuid import uuid4

from cloudrc.base.errors import BadInputError, MissingPrerequisiteError
from cloudrc.base.outside.reuse import reuse
from cloudrc.config.hull import hull_of
from cloudrc.config.robot import RobotFiles, known_robot
from cloudrc.config.scene import scene_of
from cloudrc.config.schema import World
from cloudrc.config.shipped import file_of
from cloudrc.physics.geometry.clearance import Spheres
from cloudrc.physics.geometry.fence import Fence
from cloudrc.physics.geometry.obstacles import fence_of
from cloudrc.physics.geometry.scene import Scene

_NAMES = ("robot", "scene", "fence_m")
"""Keys of `world` that decide which files are read."""


class WorldFiles:
    """A robot and its scene, as their files describe them.

    Attributes:
        robot: The content of robot.yaml, with absolute paths.
        scene: The scene as numbers, with the fence of the experiment.
    """

    def __init__(self, robot: RobotFiles, scene: Scene, names: tuple[Any, ...], token: str) -> None:
        """Give the contents of the files; `names` are the values of `_NAMES`.

        `token` is equal for the copies of this object in other processes.
        """
        self.robot, self.scene = robot, scene
        self._names, self._token = names, token

    def __reduce__(self) -> Any:
        """Travel to a worker without what each process compiles itself."""
        return _arrive, (self.robot, self.scene, self._names, self._token)

    @cached_property
    def fence(self) -> Fence:
        """The fence inside which an operator steers; for a planar robot, at its height only."""
        return fence_of(self.scene, planar=self.robot.planar)

    @cached_property
    def hull(self) -> Spheres:
        """The spheres that contain the robot.

        Raises:
            BadInputError: If its model or its file of spheres is wrong.
            MissingPrerequisiteError: If it gives no hull_m, and MuJoCo is missing.
        """
        return hull_of(self._names[0], self.robot)

    @property
    def known_hull(self) -> Spheres | None:
        """The hull of the robot; None if its files cannot be read here."""
        try:
            return self.hull
        except (BadInputError, MissingPrerequisiteError):
            return None

    @cached_property
    def compiled(self) -> Any:
        """The `MjModel` of the robot in its scene; who may change it takes a copy."""
        from cloudrc.physics.sim.scene import compile_model

        return compile_model(self.robot.model, file_of(self._names[1]))


_arrived: dict[str, WorldFiles] = {}
"""Of a worker: token -> robot and scene, which all its flights share."""


def _arrive(*parts: Any) -> WorldFiles:
    """Return robot and scene in a worker, once for all flights that have them."""
    return _arrived.setdefault(parts[-1], WorldFiles(*parts))


def read_world(world: World) -> WorldFiles:
    """Read robot and scene of a section `world`; the points of a sweep share them.

    Raises:
        BadInputError: If a file is wrong.
    """
    names = tuple(getattr(world, name) for name in _NAMES)

    def read() -> WorldFiles:
        return WorldFiles(known_robot(world.robot), scene_of(world), names, uuid4().hex)

    return reuse(("world files", names), read)


class ResolvedWorld(World):
    """The section `world`, with its robot and its scene."""

    @cached_property
    def files(self) -> WorldFiles:
        """Robot and scene, read when the experiment is resolved.

        Of a flight that is over, they are read when somebody asks: they may be gone.
        """
        return read_world(self)

    def model_copy(self, *, update: Mapping[str, Any] | None = None, deep: bool = False) -> Self:
        """Copy as pydantic does; with another robot or scene, its files are read anew."""
        copied = super().model_copy(update=update, deep=deep)
        if not {*_NAMES}.isdisjoint(update or ()):
            vars(copied).pop("files", None)
        return copied
