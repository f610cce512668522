# SPDX-License-Identifier: Apache-2.0

"""A waypoint may have a yaw only if the robot obeys one; robot.yaml says whether it does."""

from math import radians

import pytest

from cloudrc.config.load import load_experiment
from cloudrc.config.robot import find_robot
from cloudrc.flight.assembly.plan import build_plan
from tests.config.conftest import refused_line


def waypoint(robot, keys):
    """Return the settings of a mission with one waypoint."""
    point = "[1, 0]" if robot == "rover" else "[0, 0, 1]"
    mission = f"mission={{waypoints: [{{position_m: {point}{keys}}}]}}"
    return f"world.robot={robot}", "world.scene=empty", mission


@pytest.mark.parametrize(
    ("robot", "keys", "message"),
    [
        ("pelican", ", yaw_deg: 90", "90: the onboard controller of this robot holds"),
        ("rover", ", yaw_deg: 90", "90: the heading of this robot follows its velocity"),
        ("x2", ", yaw_deg: 9, yaw_tolerance_deg: 0", "must be > 0"),
    ],
)
def test_a_yaw_that_the_robot_does_not_obey_is_refused_in_one_line(robot, keys, message):
    line = refused_line("steps", *waypoint(robot, keys))
    assert message in line
    assert "mission.waypoints.0.yaw" in line


@pytest.mark.parametrize(
    ("keys", "yaw", "tolerance"),
    [(", yaw_deg: -170, yaw_tolerance_deg: 2", -170, 2), (", yaw_deg: 0", 0, 5), ("", None, 5)],
)
def test_a_yaw_of_a_robot_that_obeys_reaches_the_plan(keys, yaw, tolerance):
    (leg,) = build_plan(load_experiment("steps", waypoint("x2", keys))).legs
    assert leg.yaw == (yaw if yaw is None else radians(yaw))
    assert leg.yaw_tolerance == radians(tolerance)


@pytest.mark.parametrize(
    ("text", "heading"),
    [
        ("onboard: multirotor", "free"),
        ("onboard: diff_drive\nplanar: true", "velocity"),
        ("onboard: ./own.py\nplanar: true\nheading: free", "free"),
        ("onboard: ./own.py\nheading: fixed", "fixed"),
    ],
)
def test_robot_yaml_says_what_decides_about_the_heading(tmp_path, text, heading):
    (tmp_path / "robot.yaml").write_text(text)
    assert find_robot(str(tmp_path)).heading == heading
