"""Scenes with another spawn, so that a test can start in the air or beside the board."""

import numpy as np
import pytest

from cloudrc.world.scene import FOLDER

SPAWN = 'name="spawn" pos="0 0 .1"'


@pytest.fixture
def scene_at(tmp_path):
    """Return a function that writes a shipped scene with its spawn at (x, y, z) [m]."""

    def write(x, y, z, scene="pipes"):
        text = (FOLDER / "scenes" / f"{scene}.xml").read_text()
        assert SPAWN in text
        path = tmp_path / f"{scene}_{x}_{y}_{z}.xml"
        path.write_text(text.replace(SPAWN, f'name="spawn" pos="{x} {y} {z}"'))
        return str(path)

    return write


def normalised(quaternion):
    """Return a unit quaternion (wxyz) and its rotation matrix."""
    w, *q = quaternion / np.linalg.norm(quaternion)
    cross = np.array([[0, -q[2], q[1]], [q[2], 0, -q[0]], [-q[1], q[0], 0]])
    return (w, *q), np.eye(3) + 2 * w * cross + 2 * cross @ cross
