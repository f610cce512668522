# SPDX-License-Identifier: Apache-2.0

"""The scene of an experiment, with the fence that the experiment may give it."""

from __future__ import annotations

from importlib.util import find_spec

from cloudrc.base.outside.refusal import naming
from cloudrc.base.outside.reuse import reuse
from cloudrc.config.schema import World
from cloudrc.physics.geometry.scene import Scene, load_scene


def has_mujoco() -> bool:
    """Return whether MuJoCo is here; it may lack where flights in a cluster are started."""
    return find_spec("mujoco") is not None


def scene_of(world: World) -> Scene:
    """Read the scene of an experiment; its fence is world.fence_m if this key is given.

    Shapes that the scene declares as numbers are read without MuJoCo, all others with MuJoCo. If it
    is not installed, the others are missing, and the scene still has its `path`.
    """
    return reuse(("scene", world.scene, world.fence_m), lambda: _read(world))


def _read(world: World) -> Scene:
    with naming("world.scene"):
        scene = load_scene(world.scene, world.fence_m)
        if scene.path is None or not has_mujoco():
            return scene
        from cloudrc.physics.sim.bodies import complete

        return complete(scene)
