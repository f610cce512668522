# SPDX-License-Identifier: Apache-2.0

"""Read the shapes and the numbers of an experiment's robot and scene."""

from __future__ import annotations

from cloudrc.base.outside.refusal import naming
from cloudrc.config.flown import FLOWN_FILE, FlownWorld
from cloudrc.config.hull import known_hull
from cloudrc.config.robot import known_robot
from cloudrc.config.scene import scene_of
from cloudrc.config.schema import World
from cloudrc.config.shipped import file_of
from cloudrc.physics.geometry.shapes import SHAPES_FILE, Shapes
from cloudrc.physics.sim.scene import compile_model
from cloudrc.physics.sim.shapes import shapes_of


def read_shapes(world: World) -> Shapes:
    """Compile the robot and its scene, and return their shapes."""
    robot = known_robot(world.robot)
    with naming(f"robot {world.robot}"):
        model = compile_model(robot.model, file_of(world.scene))
        site = None if robot.scan is None else robot.scan.site
        return shapes_of(model, planar=robot.planar, scan_site=site, camera=robot.camera)


def flown_files(world: World) -> dict[str, bytes]:
    """Return what to attach to a recording, name -> content: what a report needs of the world."""
    planar = known_robot(world.robot).planar
    flown = FlownWorld(scene_of(world), known_hull(world.robot), planar)
    return {SHAPES_FILE: read_shapes(world).to_bytes(), FLOWN_FILE: flown.to_bytes()}
