"""A waypoint may have a yaw only if the robot obeys one; robot.yaml says whether it does."""

import json
from math import radians

import pytest

from cloudrc.assembly import build_plan
from cloudrc.config.load import load_experiment
from cloudrc.config.robot import find_robot
from cloudrc.errors import BadInputError


def flown(robot, point=(0, 0, 1), **keys):
    waypoint = json.dumps({"position_m": list(point), **keys})
    where = [f"world.robot={robot}", "world.scene=empty"]
    return load_experiment("steps", [*where, f"mission={{waypoints: [{waypoint}]}}"])


@pytest.mark.parametrize(
    ("robot", "point", "keys", "message"),
    [
        ("pelican", (0, 0, 1), {"yaw_deg": 90}, "90: the onboard controller of this robot holds"),
        ("rover", (1, 0), {"yaw_deg": 90}, "90: the heading of this robot follows its velocity"),
        ("x2", (0, 0, 1), {"yaw_deg": 9, "yaw_tolerance_deg": 0}, "must be > 0"),
    ],
)
def test_a_yaw_that_the_robot_does_not_obey_is_refused_in_one_line(robot, point, keys, message):
    with pytest.raises(BadInputError) as error:
        flown(robot, point, **keys)
    assert message in str(error.value)
    assert "mission.waypoints.0.yaw" in str(error.value)
    assert "\n" not in str(error.value)


def test_a_yaw_of_a_robot_that_obeys_reaches_the_plan():
    (leg,) = build_plan(flown("x2", yaw_deg=-170, yaw_tolerance_deg=2)).legs
    assert (leg.yaw, leg.yaw_tolerance) == (radians(-170), radians(2))
    (other,) = build_plan(flown("x2", yaw_deg=0)).legs
    assert (other.yaw, other.yaw_tolerance) == (0.0, radians(5))
    assert build_plan(flown("x2")).legs[0].yaw is None


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
