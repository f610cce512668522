"""Helpers of the tests of world."""

import numpy as np

from cloudrc.robots.pelican.rotors import Rotors
from cloudrc.world.robot import STEP
from cloudrc.world.simulator import Simulator


def normalised(quaternion):
    """Return a unit quaternion (wxyz) and its rotation matrix."""
    w, *q = quaternion / np.linalg.norm(quaternion)
    cross = np.array([[0, -q[2], q[1]], [q[2], 0, -q[0]], [-q[1], q[0], 0]])
    return (w, *q), np.eye(3) + 2 * w * cross + 2 * cross @ cross


def simulate(robot="pelican", scene="empty", plant=None):
    """Return a simulator of the Pelican, or of a changed copy of it, with its rotors."""
    return Simulator(robot, scene, plant, actuators=Rotors(STEP))
