# SPDX-License-Identifier: Apache-2.0

"""The limits of the guard come from the robot; an experiment may lower them."""

import re

import pytest

from cloudrc.config.load import load_experiment
from cloudrc.config.resolved import dump
from tests.config.conftest import refused, refused_line

DRIVES = ["world.robot=rover", "mission={waypoints: [{position_m: [1, 0]}]}", "world.scene=empty"]
FLIES = ["mission={waypoints: [{position_m: [0.5, 0, 1]}]}"]


@pytest.mark.parametrize(
    ("settings", "speed", "acceleration"),
    [
        (["world.robot=pelican", *FLIES], 6.0, 12.0),
        (["world.robot=nano", *FLIES], 6.0, 4.0),
        (DRIVES, 1.5, 2.0),
        ([*DRIVES, "guard.speed_max_mps=0.5"], 0.5, 2.0),
        ([*DRIVES, "guard.acceleration_max_mps2=1"], 1.5, 1.0),
        ([*DRIVES, "guard.command_age_max_ms=10000"], 0.835811, 2.0),
    ],
)
def test_limits_are_those_of_the_robot_unless_the_experiment_lowers_them(
    settings, speed, acceleration
):
    guard = load_experiment("steps", settings).guard
    assert guard.speed_max_mps == pytest.approx(speed, abs=1e-5)
    assert guard.acceleration_max_mps2 == acceleration


def test_a_robot_that_brakes_less_gets_a_lower_speed_cap(tmp_path):
    text = "{onboard: multirotor, hull_m: 0.3, guard: {braking_mps2: 1.5}}"
    (tmp_path / "robot.yaml").write_text(text)
    settings = [f"world.robot={tmp_path}", *FLIES]
    # v 0.45 s + v^2 / 3 = 8.7 m
    assert load_experiment("steps", settings).guard.speed_max_mps == pytest.approx(4.478, abs=1e-3)
    text = refused("steps", *settings, "guard.speed_max_mps=5")
    assert re.search(r"must be at most 4\.47\d* m/s: above it the robot", text)


@pytest.mark.parametrize(("robot", "most"), [(FLIES, "12"), (DRIVES, "2")])
def test_an_acceleration_above_that_of_the_robot_is_refused_in_one_line(robot, most):
    load_experiment("steps", [*robot, f"guard.acceleration_max_mps2={most}"])
    said = f"guard.acceleration_max_mps2: must be at most {most} m/s^2, the largest acceleration"
    assert said in refused_line("steps", *robot, f"guard.acceleration_max_mps2={most}.1")


def test_another_robot_in_a_resolved_experiment_brings_its_own_limits(tmp_path):
    file = tmp_path / "again.yaml"
    file.write_text(dump(load_experiment("pillars")))
    again = load_experiment(file, ["world.robot=x2", *FLIES]).guard
    assert (again.speed_max_mps, again.acceleration_max_mps2) == (6.0, 4.0)
    file.write_text(dump(load_experiment("pillars", ["guard.speed_max_mps=1"])))
    assert load_experiment(file, ["world.robot=x2", *FLIES]).guard.speed_max_mps == 1.0
