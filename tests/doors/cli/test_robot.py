# SPDX-License-Identifier: Apache-2.0

"""`cloudrc new robot` and `cloudrc check`."""

import runpy
import shutil

import pytest

from cloudrc.config.shipped import FOLDERS


@pytest.fixture
def mine(tmp_path, call):
    folder = tmp_path / "my_robot"
    assert f"cloudrc check {folder}" in call("new robot", folder).out
    return folder


def replace(file, old, new):
    text = file.read_text()
    assert old in text
    file.write_text(text.replace(old, new))


def test_a_new_robot_is_complete_and_its_test_flies_it(mine):
    names = {each.name for each in mine.iterdir()}
    assert names == {"robot.xml", "robot.yaml", "test_robot.py"}
    runpy.run_path(mine / "test_robot.py")["test_the_robot_hovers"]()


@pytest.fixture
def wheeled(tmp_path):
    return shutil.copytree(FOLDERS["robot"] / "rover", tmp_path / "wheeled")


@pytest.mark.parametrize(
    ("onboard", "count"),
    [("turn_rate_max: 0.05", 1), ("turn_rate_max: 1", 0)],
)
def test_the_check_lets_a_robot_with_wheels_turn(wheeled, as_json, onboard, count):
    given = f"onboard: {{name: diff_drive, {onboard}}}"
    replace(wheeled / "robot.yaml", "onboard: diff_drive", given)
    found = as_json("check", wheeled, code=2 * count)["changes"]
    assert [("to its left" in text, "turn_rate_max" in text) for text in found] == [
        (True,) * 2
    ] * count


def test_a_planar_robot_that_does_not_rest_at_the_height_of_the_spawn_is_refused(wheeled, refused):
    replace(wheeled / "robot.xml", 'size=".08 .01"', 'size=".03 .01"')
    replace(wheeled / "robot.xml", 'pos="-.2 0 -.07"', 'pos="-.2 0 -.02"')
    run = f"run pillars --mode virtual --out run --set world.robot={wheeled}"
    for command in (f"check {wheeled}", run):
        assert "rests at a height of 0.050" in refused(command)


def test_a_folder_with_files_stays_as_it_is(mine, refused):
    before = (mine / "robot.yaml").read_text()
    assert "already exists; name a new folder" in refused("new robot", mine)
    assert (mine / "robot.yaml").read_text() == before


def test_a_new_robot_needs_no_change(mine, as_json):
    found = as_json("check", mine)
    assert found["ok"]
    assert found["facts"]["mass_kg"] == pytest.approx(1.3)
    assert found["facts"]["rotors_turn"]["front_right"] == "clockwise"
    assert found["facts"]["rotors_turn"]["front_left"] == "counter-clockwise"
    assert (mine / "check.png").read_bytes().startswith(b"\x89PNG")


@pytest.mark.parametrize("robot", ["pelican", "nano", "rover"])
def test_a_shipped_robot_needs_no_change(robot, call, tmp_path):
    assert "nothing must change" in call("check", robot).out
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("old", "new", "shown"),
    [
        ("hull_m: 0.34", "hull_m: 0.1", "hull_m is 0.1, but the geoms reach 0.333 m from the base"),
        ("braking_mps2: 3", "braking_mps2: 9", "guard.braking_mps2 is 9, but"),
        ("onboard: multirotor", "onboard: ./own.py", "own.py:10: NameError"),
        ("onboard: multirotor", "onboard: ./turns.py", "the robot turns over"),
    ],
)
def test_what_must_change_is_a_line_each_and_exit_code_2(mine, call, old, new, shown):
    law = "from cloudrc.robots.onboard.multirotor import build as general\n"
    own = """
class Mine:
    stopped = (0.0,) * 4

    def reset(self):
        pass

    def update(self, readings, velocity, yaw_rate):
        {0}

    brake = update


def build(model):
    return Mine()
"""
    (mine / "own.py").write_text(law + own.replace("{0}", "return commands"))
    (mine / "turns.py").write_text(own.replace("{0}", "return (8.0, 8.0, 0.0, 0.0)"))
    replace(mine / "robot.yaml", old, new)
    out = call("check", mine, code=2).out
    (line,) = [each for each in out.splitlines() if each.startswith("must change: ")]
    assert shown in line


@pytest.mark.parametrize(
    ("old", "new", "shown"),
    [
        ('mass="1.22"', 'mass="1220"', "kg, not g"),
        (' gear="0 0 1 0 0 .02"', ' gear="0 0 1"', "which has no room"),
    ],
)
def test_a_model_that_cannot_fly_is_refused_in_one_line(mine, refused, old, new, shown):
    replace(mine / "robot.xml", old, new)
    assert shown in refused("check", mine)
