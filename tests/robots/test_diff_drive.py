# SPDX-License-Identifier: Apache-2.0

"""A robot with driven wheels goes where the wanted velocity points; unfit models are refused."""

from math import atan2, cos, degrees, hypot, pi, radians, sin

import numpy as np
import pytest

import cloudrc
from cloudrc.config.load import load_experiment
from cloudrc.config.resolved import ResolvedGuard
from cloudrc.config.robot import find_robot
from cloudrc.config.world import ResolvedWorld
from cloudrc.robots.build import build_robot
from tests.robots.conftest import refused

MODEL = find_robot("rover").model
TEXT = MODEL.read_text()
SERVO = '<velocity kv="3" ctrlrange="-20 20" forcerange="-3 3"/>'


@pytest.fixture
def drive(own_robot):
    """Return a function that drives the rover with velocities (x, y, z, yaw rate), 2 s each."""

    def go(*wanted, model=TEXT, onboard="diff_drive", time=2.0):
        folder = own_robot(f"onboard: {onboard}\nplanar: true", model)
        robot = build_robot(ResolvedWorld(robot=str(folder), scene="empty"), ResolvedGuard())
        simulator, controller = robot.simulator, robot.onboard
        for *velocity, yaw_rate in wanted:
            for _ in range(round(time / simulator.dt)):
                simulator.step(controller.update(simulator.readings, tuple(velocity), yaw_rate))
        return simulator

    return go


def changed(changes):
    """Return the text of the rover's model with other words."""
    model = TEXT
    for old, new in changes.items():
        assert old in model
        model = model.replace(old, new)
    return model


def heading(simulator):
    return atan2(simulator.readings.axes[1], simulator.readings.axes[0])


@pytest.mark.parametrize("degree", [0, 80, 135, -120])
def test_it_drives_where_the_velocity_points_with_its_nearer_end(drive, degree):
    x, y = 0.8 * cos(radians(degree)), 0.8 * sin(radians(degree))
    simulator = drive((x, y, 0.0, 0.0), time=3.0)
    assert simulator.readings.velocity == pytest.approx((x, y, 0.0), abs=0.03)
    ends = degree if abs(degree) <= 100 else degree - 180 if degree > 0 else degree + 180
    assert degrees(heading(simulator)) == pytest.approx(ends, abs=2.0)


def test_a_reversed_velocity_makes_it_drive_back_without_a_turn(drive):
    simulator = drive((0.8, 0.0, 0.0, 0.0), (-0.8, 0.0, 0.0, 0.0))
    assert simulator.readings.velocity[0] == pytest.approx(-0.8, abs=0.01)
    assert abs(heading(simulator)) < 0.01


def test_at_rest_it_turns_with_the_yaw_rate_and_while_it_drives_the_velocity_decides(drive):
    turned = drive((0.0, 0.0, 0.0, 0.5))
    assert turned.readings.angular_velocity_body[2] == pytest.approx(0.5, abs=0.05)
    assert hypot(*turned.readings.position[:2]) < 0.01
    near = drive((0.0, 0.04, 0.0, 0.5))  # a few centimetres beside the goal
    assert heading(near) == pytest.approx(1.0, abs=0.1)
    assert abs(heading(drive((0.8, 0.0, 0.0, 0.5)))) < 0.01


def test_no_wheel_is_faster_than_its_limit_and_turning_comes_first():
    robot = build_robot(ResolvedWorld(robot="rover", scene="empty"), ResolvedGuard())
    controller, readings = robot.onboard, robot.simulator.readings
    assert controller.update(readings, (50.0, 0.0, 0.0), 0.0) == pytest.approx((20.0, 20.0))
    left, right = controller.update(readings, (50.0, 50.0, 0.0), 0.0)
    assert right == pytest.approx(20.0)
    assert (right - left) * 0.08 / 0.32 == pytest.approx(min(3.0, 3.0 * pi / 4))


@pytest.mark.parametrize(
    "changes",
    [
        {SERVO: SERVO.replace("kv", 'gear="-2" kv').replace("20", "40")},
        {'size=".08 .01"': 'size=".06 .01"', ".16 -.02": ".16 -.04", "20 20": "30 30"},
        {"0 .16": "0 .25", "0 -.16": "0 -.25"},
    ],
    ids=["gear", "radius", "track"],
)
def test_directions_gears_radius_and_track_of_the_wheels_come_from_the_model(drive, changes):
    model = changed(changes)
    driven = drive((0.8, 0.0, 0.0, 0.0), model=model).readings
    assert driven.velocity == pytest.approx((0.8, 0.0, 0.0), abs=0.03)
    turned = drive((0.0, 0.0, 0.0, 0.5), model=model).readings
    assert turned.angular_velocity_body[2] == pytest.approx(0.5, abs=0.05)


def test_a_robot_with_four_driven_wheels_drives(drive):
    back = "".join(
        f'<body name="back_{side}" pos="-.2 {y} -.02" childclass="wheel">'
        f'<joint name="back_{side}"/><geom/></body>'
        for side, y in (("left", ".16"), ("right", "-.16"))
    )
    servos = "".join(
        f'<velocity class="wheel" name="back_{side}" joint="back_{side}"/>'
        for side in ("left", "right")
    )
    model = TEXT.replace("</body>\n  </worldbody>", f"{back}</body>\n  </worldbody>")
    model = model.replace("</actuator>", f"{servos}</actuator>")
    simulator = drive((0.8, 0.0, 0.0, 0.0), (0.0, 0.8, 0.0, 0.0), model=model, time=3.0)
    assert simulator.readings.velocity == pytest.approx((0.0, 0.8, 0.0), abs=0.06)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({SERVO: '<motor ctrlrange="-1 1"/>', "<velocity class": "<motor class"}, "velocity servo"),
        ({'type="hinge"': 'type="slide"'}, "it must turn the hinge of a wheel"),
        ({'type="cylinder" size=".08 .01"': 'type="box" size=".1 .1 .1"'}, "wheel_radius_m"),
    ],
)
def test_a_model_without_such_wheels_is_refused_in_one_line(own_robot, changes, message):
    folder = own_robot("onboard: diff_drive\nplanar: true", changed(changes))
    line = refused(robot=str(folder))
    assert message in line
    assert str(folder / "robot.xml") in line


def fly_pillars(judged_by):
    """Return a flight of `pillars`, and the time of its last waypoint [s]."""
    keys = {"link.profile": "ideal", "link.both.delay_ms": 200, "guard.command_age_max_ms": 700}
    keys |= {"cloud.predictor": "command_history", "mission.judged_by": judged_by}
    flight = cloudrc.fly("pillars", keys)
    mission = flight["/mission"]
    return flight, 1e-9 * int(np.ptp(mission["stamp_ns"][mission["event"] != "done"]))


def test_a_mission_that_is_judged_by_predictions_loses_no_round_trip_at_its_waypoints():
    (slow, slow_end), (fast, fast_end) = map(fly_pillars, ("measured", "predicted"))
    assert slow.verdict == fast.verdict == "success"
    assert fast_end < slow_end - 3 * 0.4  # three waypoints without a dwell time
    truth = fast["/ground_truth"]["position"]
    for waypoint in load_experiment("pillars").mission.waypoints:
        away = np.linalg.norm(truth - waypoint.position_m, axis=1)
        assert away.min() <= waypoint.tolerance_m
