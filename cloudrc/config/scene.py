"""The scene of an experiment, with the fence that the experiment may give it."""

from __future__ import annotations

from dataclasses import replace

from cloudrc.config.robot import is_planar
from cloudrc.config.schema import World
from cloudrc.geometry.fence import Fence
from cloudrc.geometry.obstacles import fence_of
from cloudrc.geometry.scene import Scene, load_scene
from cloudrc.outside.reuse import reuse


def scene_of(world: World) -> Scene:
    """Read the scene of an experiment; its fence is world.fence_m if this key is given."""
    key = "scene", world.scene, world.fence_m
    return reuse(key, lambda: load_scene(world.scene, world.fence_m))


def steered_in(world: World) -> Fence:
    """Return the fence inside which an operator steers; for a planar robot, at its height only."""
    fence = fence_in(world)
    if is_planar(world.robot):
        return replace(fence, ground=scene_of(world).spawn[2])
    return fence


def fence_in(world: World) -> Fence:
    """Return the fence of an experiment; raise errors as `fence_of` does."""
    return fence_of(scene_of(world))
