"""Helpers of the tests of world."""

import numpy as np


def normalised(quaternion):
    """Return a unit quaternion (wxyz) and its rotation matrix."""
    w, *q = quaternion / np.linalg.norm(quaternion)
    cross = np.array([[0, -q[2], q[1]], [q[2], 0, -q[0]], [-q[1], q[0], 0]])
    return (w, *q), np.eye(3) + 2 * w * cross + 2 * cross @ cross
