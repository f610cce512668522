# SPDX-License-Identifier: Apache-2.0

"""Robot and scene of a resolved experiment are read once, and anew where another one is asked."""

import shutil

import pytest

from cloudrc.config.load import load_experiment
from cloudrc.config.robot import find_robot
from cloudrc.config.world import ResolvedWorld


@pytest.fixture
def own_robot(tmp_path):
    """A copy of the rover, whose files a test may change."""
    return shutil.copytree(find_robot("rover").model.parent, tmp_path / "mine")


def test_robot_and_scene_are_attributes_that_copies_share():
    first = load_experiment("pillars")
    again = first.model_copy(update={"seed": 9})
    assert first.robot.planar
    assert first.robot is again.robot
    assert first.scene is again.scene
    assert first.scene.name == "pillars"
    assert first == load_experiment("pillars"), "equal values, although it is read again"


@pytest.mark.parametrize(
    "changed", [{"robot": "nano"}, {"scene": "empty"}, {"fence_m": ((-1, -1, 0), (1, 1, 1))}]
)
def test_a_copy_with_another_robot_or_scene_reads_it(changed):
    world = ResolvedWorld(robot="x2", scene="pipes")
    before, other = world.files, world.model_copy(update=changed)
    assert other.files is not before
    assert world.model_copy(update={"scan": True}).files is before
    assert (other.files.robot.model == before.robot.model) == ("robot" not in changed)
    assert (other.files.scene == before.scene) == ("robot" in changed)


def test_an_edited_robot_counts_at_the_next_command(own_robot):
    settings = [f"world.robot={own_robot}"]
    before = load_experiment("pillars", settings)
    file = own_robot / "robot.yaml"
    file.write_text(file.read_text().replace("speed_max_mps: 1.5", "speed_max_mps: 0.5"))
    after = load_experiment("pillars", settings)
    assert after.robot.guard.speed_max_mps == 0.5 != before.robot.guard.speed_max_mps
