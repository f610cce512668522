# SPDX-License-Identifier: Apache-2.0

"""Helpers of the tests of world."""

from cloudrc.config.robot import find_robot
from cloudrc.config.shipped import file_of
from cloudrc.physics.sim.scene import compile_model, compile_true
from cloudrc.physics.sim.simulator import Simulator
from cloudrc.robots.pelican.rotors import Rotors
from cloudrc.world.robot import STEP


def model_of(robot="pelican", scene="empty", plant=None):
    """Compile a robot in a scene, given by names or paths; `plant` changes the true robot."""
    files = find_robot(robot).model, file_of(scene)
    nominal = compile_model(*files)
    return nominal if plant is None else compile_true(*files, nominal, plant)


def simulate(robot="pelican", scene="empty", plant=None):
    """Return a simulator of the Pelican, or of a changed copy of it, with its rotors."""
    return Simulator(model_of(robot, scene, plant), Rotors(STEP), probe="tip")
