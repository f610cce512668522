# SPDX-License-Identifier: Apache-2.0

"""Read the shapes and the numbers of an experiment's robot and scene."""

from __future__ import annotations

from cloudrc.base.outside.refusal import naming
from cloudrc.config.flown import FLOWN_FILE, FlownWorld
from cloudrc.config.world import ResolvedWorld
from cloudrc.physics.geometry.shapes import SHAPES_FILE, Shapes
from cloudrc.physics.sim.shapes import shapes_of


def read_shapes(world: ResolvedWorld) -> Shapes:
    """Compile the robot and its scene, and return their shapes."""
    robot = world.files.robot
    with naming(f"robot {world.robot}"):
        site = None if robot.scan is None else robot.scan.site
        model = world.files.compiled
        return shapes_of(model, planar=robot.planar, scan_site=site, camera=robot.camera)


def flown_files(world: ResolvedWorld) -> dict[str, bytes]:
    """Return what to attach to a recording, name -> content: what a report needs of the world."""
    flown = FlownWorld.of(world.files)
    return {SHAPES_FILE: read_shapes(world).to_bytes(), FLOWN_FILE: flown.to_bytes()}
