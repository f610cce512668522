# SPDX-License-Identifier: Apache-2.0

"""Limits and size of a robot in robot.yaml; a wrong value is one line with file, line and key."""

import pytest

from cloudrc.base.errors import BadInputError
from cloudrc.config.robot import find_robot


@pytest.fixture
def read(tmp_path):
    """Return a function that reads a robot.yaml with these keys."""

    def find(*keys, onboard="multirotor"):
        lines = "\n".join([f"onboard: {onboard}", *keys])
        (tmp_path / "robot.yaml").write_text(lines)
        return find_robot(str(tmp_path))

    return find


@pytest.mark.parametrize(
    ("onboard", "keys", "stop"),
    [
        ("multirotor", [], "land"),
        ("diff_drive", ["planar: true"], "brake"),
        ("multirotor", ["guard: {stop: brake}"], "brake"),
    ],
)
def test_a_robot_lands_unless_it_is_planar_or_says_that_it_brakes(read, onboard, keys, stop):
    assert read(*keys, onboard=onboard).guard.stop == stop


def test_limits_and_hull_are_read_and_have_defaults(read):
    assert read().guard.model_dump() == {
        "speed_max_mps": None,
        "acceleration_max_mps2": 4.0,
        "braking_mps2": 3.0,
        "stop": "land",
    }
    assert read().hull_m is None
    robot = read("guard: {braking_mps2: 2, speed_max_mps: 1.5}", "hull_m: 0.35")
    assert (robot.guard.braking_mps2, robot.guard.speed_max_mps, robot.hull_m) == (2.0, 1.5, 0.35)


def test_a_planar_robot_does_not_land(read):
    with pytest.raises(BadInputError, match=r"guard\.stop is land, but planar"):
        read("planar: true", "guard: {stop: land}")
