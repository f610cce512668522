# SPDX-License-Identifier: Apache-2.0

"""A robot's own sensors: `robot.yaml` names them, and every reader knows their names."""

import numpy as np
import pytest

import cloudrc
from cloudrc.config.robot import find_robot
from tests.robots.conftest import CONTROLLER, HOVER, refused

PELICAN = find_robot("pelican").model.read_text()
EYE = '<site name="eye" pos="0 0 -.1001" zaxis="0 0 -1"/><geom name="base" type="box"'
SENSORS = """
    <touch name="tip" site="tip"/>
    <rangefinder name="ground" site="eye"/>
    <actuatorfrc name="front" actuator="rotor_front"/>
    <gyro name="gyro" site="eye"/>
"""
MODEL = PELICAN.replace('<geom name="base" type="box"', EYE).replace(
    '<touch name="tip" site="tip"/>', SENSORS
)


@pytest.fixture
def seeing(own_robot):
    """Return a function that writes a robot whose `robot.yaml` has the given further lines."""

    def write(*lines):
        return str(own_robot("\n".join((f"onboard: {CONTROLLER}", *lines)), MODEL))

    return write


def test_a_recording_has_each_sensor_with_name_and_unit_and_telemetry_carries_it(seeing):
    robot = seeing(
        "sensors:",
        "  height: {unit: m, sensor: ground}",
        "  thrust: {unit: N, sensor: front}",
    )
    found = cloudrc.fly("hover", HOVER | {"world.robot": robot})
    assert found.verdict == "success"
    rows = found["/sensor"]
    assert {*zip(rows["name"], rows["unit"], strict=True)} == {("height", "m"), ("thrust", "N")}
    height = rows["value"][rows["name"] == "height"]
    truth = found["/ground_truth"]["position"][:, 2]
    assert len(height) == len(truth)
    assert height[-100:] == pytest.approx(truth[-100:] - 0.1, abs=0.02)
    assert rows["value"][rows["name"] == "thrust"][-1] == pytest.approx(1.06 * 9.81 / 4, rel=0.1)


@pytest.mark.promise("unknown-is-absent")
def test_a_robot_without_a_probe_has_no_contact_force_and_no_number_about_it(seeing):
    robot = seeing("sensors: {force: {unit: N, sensor: tip}}")
    found = cloudrc.fly("hover", HOVER | {"world.robot": robot})
    assert len(found["/contact_force"]) == 0
    assert len(found["/sensor"]) > 100
    assert not [name for name in found.numbers if "force" in name or "impulse" in name]


def test_the_pelican_tells_the_force_on_its_probe_as_its_own_sensor():
    found = cloudrc.fly("hover", HOVER)
    sensor, force = found["/sensor"], found["/contact_force"]
    assert {*zip(sensor["name"], sensor["unit"], strict=True)} == {("contact_force", "N")}
    assert np.array_equal(sensor["value"], force["force"])


@pytest.mark.parametrize(
    ("sensor", "said"),
    [
        ("grund", "no sensor of the model named 'grund'; available: "),
        ("gyro", "gyro shows 3 numbers; name a sensor that shows one"),
    ],
)
def test_a_sensor_that_the_model_lacks_is_refused_in_one_line(seeing, sensor, said):
    robot = seeing(f"sensors: {{height: {{unit: m, sensor: {sensor}}}}}")
    assert refused(robot=robot).startswith(f"{robot}/robot.yaml: sensors.height.sensor: {said}")
