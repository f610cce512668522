# SPDX-License-Identifier: Apache-2.0

"""A robot of one's own in a folder."""

import json

import pytest

from cloudrc.base.errors import BadInputError
from cloudrc.config.robot import find_robot
from cloudrc.config.world import ResolvedWorld
from cloudrc.robots.build import check_robot

CONTROLLER = find_robot("pelican").onboard.name
HOVER = {"mission": {"waypoints": [{"position_m": [0, 0, 1.0]}]}, "world.scene": "empty"}


def world(**keys):
    return ResolvedWorld.model_validate_json(json.dumps({"scene": "empty", **keys}))


def refused(**keys):
    """Return the line with which a robot in a world is refused."""
    with pytest.raises(BadInputError) as error:
        check_robot(world(**keys))
    assert "\n" not in str(error.value)
    return str(error.value)


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
