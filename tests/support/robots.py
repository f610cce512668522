# SPDX-License-Identifier: Apache-2.0

"""Robots without an experiment."""

from cloudrc.config.robot import facts
from cloudrc.config.world import ResolvedWorld


def facts_of(robot, acceleration_max):
    """Return what cloud knows of a robot under a limit of the guard [m/s^2]."""
    world = ResolvedWorld(robot=robot)
    return facts(world.files.robot, world, acceleration_max)
