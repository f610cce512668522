"""A robot of one's own in a folder."""

import pytest

from cloudrc.config.robot import find_robot

CONTROLLER = find_robot("pelican").onboard.name
HOVER = {"mission": {"waypoints": [{"position_m": [0, 0, 1.0]}]}, "world.scene": "empty"}


@pytest.fixture
def own_robot(tmp_path):
    """Return a function that writes a folder with a robot: the Pelican's model, a `robot.yaml`."""

    def write(text, model=None):
        folder = tmp_path / "mine"
        folder.mkdir(exist_ok=True)
        (folder / "robot.yaml").write_text(text)
        (folder / "robot.xml").write_text(model or find_robot("pelican").model.read_text())
        return folder

    return write
