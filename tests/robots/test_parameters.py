# SPDX-License-Identifier: Apache-2.0

"""Parameters on board, a robot unlike its model, and wind, for every robot."""

import pytest

import cloudrc
from cloudrc.config import shipped
from cloudrc.config.robot import find_robot
from cloudrc.results.metrics.velocity_loop import identify, series
from cloudrc.robots.build import check_robot
from tests.conftest import nightly
from tests.robots.conftest import refused, world


@pytest.mark.parametrize("robot", shipped.names("robot"))
def test_each_tuning_of_a_shipped_robot_is_one_that_its_controller_takes(robot):
    found = find_robot(robot)
    assert ("fast" in found.tunings) is not found.planar
    for name in found.tunings:
        check_robot(world(robot=robot, tuning=name))


@pytest.mark.parametrize("robot", ["nano", *nightly("x2")])
def test_the_experiment_fast_flies_other_robots_faster(robot):
    """Without an arm they fly the mission `legs`, which ends before the board."""
    flight = cloudrc.fly("fast", {"world.robot": robot, "mission": "legs"})
    assert flight.numbers["waypoints_reached"] == 6
    assert flight.failures == ()
    assert flight.numbers["prediction_error_rms"] < 0.006
    fits = []
    for tuning in (None, "fast"):
        keys = {"world.robot": robot, "world.tuning": tuning, "link.profile": "ideal"}
        found = cloudrc.fly("steps", keys | {"mission.steps.count": 6})
        given, measured = series(found.recording)
        axes = [identify(given[:, axis], measured[:, axis]) for axis in (0, 2)]
        fits.append([fit.values[0] + fit.values[1] for fit in axes])  # 63 % of a step is done
    assert all(fast < usual for usual, fast in zip(*fits, strict=True))


@pytest.mark.parametrize(
    ("keys", "ratio"),
    [
        ({"plant": {"actuator_factor": 0.2, "payload_kg": 1.0}}, "pelican is 1.34"),
        ({"robot": "nano", "plant": {"mass_factor": 2.0}}, "nano is 1.13"),
    ],
)
def test_a_robot_too_heavy_or_too_weak_is_refused_with_the_ratio(keys, ratio):
    text = refused(**keys)
    assert text.startswith("world.plant: the thrust-to-weight ratio of ")
    assert f"{ratio}, so it cannot lift off safely; it must be at least 1.5" in text


@pytest.mark.parametrize(
    ("keys", "hint"),
    [
        ({"robot": "nano", "onboard": {"drag_s_per_m": 0}}, "drag_s_per_m"),
        ({"robot": "rover"}, "leave the wind out"),
    ],
)
def test_wind_that_would_not_move_a_robot_is_refused(keys, hint):
    text = refused(**keys, wind={"velocity_mps": [2.0, 0.0]})
    said = f"world.wind: {keys['robot']} has actuators without drag, so wind would not"
    assert text.startswith(said)
    assert hint in text


@pytest.mark.parametrize(("robot", "drag"), [("nano", 6.84e-3), ("x2", 0.360)])
def test_a_shipped_drone_leans_against_the_wind_as_its_drag_asks(robot, drag):
    """`drag` is the force per velocity at hover, from the sources that robot.yaml names [N s/m]."""
    wind, mass = 4.0, {"nano": 0.027, "x2": 1.3}[robot]
    keys = {"world.robot": robot, "link.profile": "ideal", "mission.waypoints.0.dwell_s": 6.0}
    flight = cloudrc.fly("hover", keys | {"world.wind.velocity_mps": [wind, 0.0]})
    truth = flight["/ground_truth"]
    assert flight.verdict == "success"
    assert truth["position"][:, 0].max() > 0.05  # before the integral has found the wind
    w, x, y, z = truth["orientation_wxyz"][-100:].mean(axis=0)
    assert 2 * (x * z + w * y) == pytest.approx(-drag * wind / (mass * 9.81), rel=0.03)
