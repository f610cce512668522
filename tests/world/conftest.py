"""Helpers of the tests of world."""

import numpy as np

from cloudrc.config.robot import find_robot
from cloudrc.config.shipped import file_of
from cloudrc.robots.pelican.rotors import Rotors
from cloudrc.sim.scene import compile_model, compile_true
from cloudrc.sim.simulator import Simulator
from cloudrc.world.robot import STEP


def normalised(quaternion):
    """Return a unit quaternion (wxyz) and its rotation matrix."""
    w, *q = quaternion / np.linalg.norm(quaternion)
    cross = np.array([[0, -q[2], q[1]], [q[2], 0, -q[0]], [-q[1], q[0], 0]])
    return (w, *q), np.eye(3) + 2 * w * cross + 2 * cross @ cross


def model_of(robot="pelican", scene="empty", plant=None):
    """Compile a robot in a scene, given by names or paths; `plant` changes the true robot."""
    files = find_robot(robot).model, file_of(scene)
    nominal = compile_model(*files)
    return nominal if plant is None else compile_true(*files, nominal, plant)


def simulate(robot="pelican", scene="empty", plant=None):
    """Return a simulator of the Pelican, or of a changed copy of it, with its rotors."""
    return Simulator(model_of(robot, scene, plant), Rotors(STEP), probe="tip")
