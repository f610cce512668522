# SPDX-License-Identifier: Apache-2.0

"""Missions of a robot on the ground: two numbers are enough, heights are refused with a word."""

from functools import partial
from math import pi

import pytest

import cloudrc
from cloudrc.config.load import load_experiment
from cloudrc.flight.assembly.plan import build_plan
from cloudrc.teleop.models import RefusedError, RequestReader
from tests.config.conftest import refused, refused_line

ROVER = ["world.robot=rover", "world.scene=empty"]


def with_points(*points):
    waypoints = ", ".join(f"{{position_m: {point}}}" for point in points)
    return [*ROVER, f"mission={{waypoints: [{waypoints}]}}"]


AT_A_PILLAR = [each.replace("empty", "pillars") for each in with_points("[3.5, 0]")]


@pytest.mark.parametrize("point", ["[1, 0]", "[1, 0, 0.1]"])
def test_a_waypoint_has_two_numbers_or_the_height_of_the_spawn(point):
    experiment = load_experiment("steps", with_points(point))
    assert experiment.mission.waypoints[0].position_m == (1.0, 0.0, 0.1)


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        (with_points("[1, 0]", "[1, 1, 1]"), "waypoints.1.position_m: [1, 1, 1]: has a height"),
        (ROVER, "mission.steps: have heights, but the robot stays on the ground"),
        (AT_A_PILLAR, "within 0.04 m of pillar_2"),
    ],
)
def test_a_mission_that_leads_off_the_ground_or_away_is_refused_in_one_line(settings, message):
    assert message in refused_line("steps", *settings)


@pytest.mark.parametrize(
    ("head", "z", "message"),
    [
        ("time_s,x_m,y_m,z_m", ",0.1", ""),
        ("time_s,x_m,y_m,z_m", ",1", "line 2: z_m is 1; the guard moves the robot from 0.1"),
        ("time_s,x_m", "", "no column y_m; it has time_s, x_m; its first line must name the"),
    ],
)
def test_a_file_of_setpoints_needs_no_height_and_has_no_other_one(tmp_path, head, z, message):
    file, columns = tmp_path / "mine.csv", head.count(",") + 1
    rows = [",".join(row.split(",")[:columns]) for row in (f"0,0,0{z}", f"4,1,0.5{z}")]
    file.write_text("\n".join([head, *rows]))
    settings = [*ROVER, f"mission={{setpoints: {file}}}"]
    if message:
        assert message in refused("steps", *settings)
        return
    flight = cloudrc.fly("steps", {"world.robot": "rover", "mission": {"setpoints": str(file)}})
    assert flight.verdict == "success"
    assert flight["/ground_truth"]["position"][-1, :2] == pytest.approx((1.0, 0.5), abs=0.2)


def test_a_silent_link_makes_the_rover_hold_and_then_stop_for_good():
    silent = {"link.both.blackouts": [{"start_s": 3.0, "duration_s": 6.0}]}
    flight = cloudrc.fly("pillars", {**silent, "guard.hold_max_s": 1.0})
    assert "guard_stopped" in {failure.code for failure in flight.failures}
    assert [int(state) for state in flight["/guard"]["state"]] == [0, 1, 2, 3, 3]
    speed = abs(flight["/ground_truth"]["velocity"][-1])
    assert speed.max() < 1e-3


def test_teleop_takes_two_numbers_and_refuses_heights():
    experiment = load_experiment("pillars")
    read = RequestReader(experiment.world.files, partial(build_plan, experiment))
    taken = read.order(b'{"waypoints": [{"position_m": [1.5, 1.2]}]}')
    assert taken.plan.legs[0].position == (1.5, 1.2, 0.1)
    with pytest.raises(RefusedError, match="has a height"):
        read.order(b'{"waypoints": [{"position_m": [1.5, 1.2, 1.0]}]}')
    assert read.goto(b'{"position_m": [1, 1.2]}').position == (1.0, 1.2, 0.1)
    turned = read.goto(b'{"position_m": [1, 1.2], "yaw_deg": 180}')
    assert turned.yaw == pytest.approx(pi), "it turns on the spot"
    with pytest.raises(RefusedError, match=r"position_m: .* has a height"):
        read.goto(b'{"position_m": [1, 1.2, 1]}')
