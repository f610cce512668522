# SPDX-License-Identifier: Apache-2.0

"""A robot is a folder: description, model and onboard controller; it needs no edit elsewhere."""

import pytest

import cloudrc
from cloudrc.base.errors import BadInputError
from cloudrc.config.robot import find_robot
from tests.robots.conftest import CONTROLLER, HOVER

SENSORS = "sensors: {contact_force: {unit: N, sensor: tip}}"
CLIMBS = """
from cloudrc.robots.pelican.onboard import actuators, build as published

def build(model, climb_mps: float = 0.0):
    law = published(model)
    follow = law.update
    law.update = lambda r, v, w=0.0: follow(r, (v[0], v[1], v[2] + climb_mps), w)
    return law
"""


def test_a_folder_with_the_same_files_flies_the_same_flight(own_robot):
    mine = own_robot(f"onboard: {CONTROLLER}\nprobe: tip\n{SENSORS}")
    flights = [cloudrc.fly("hover", HOVER | {"world.robot": r}) for r in ("pelican", str(mine))]
    assert flights[0].verdict == "success"
    assert flights[0].records_sha256 == flights[1].records_sha256


def test_the_controller_may_lie_in_the_folder_and_takes_parameters(own_robot):
    mine = own_robot("onboard: ./own.py")
    (mine / "own.py").write_text(CLIMBS)
    heights = []
    for climb in (0.0, 0.2):
        (mine / "robot.yaml").write_text(f"onboard: {{name: ./own.py, climb_mps: {climb}}}")
        flight = cloudrc.fly("hover", HOVER | {"world.robot": str(mine)})
        heights.append(flight["/ground_truth"]["position"][:, 2].max())
    assert heights[1] > heights[0] + 0.05


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("onboard: Multirotor", "robot.yaml: onboard: no onboard named 'Multirotor'"),
        ("onbord: x", "robot.yaml:1: onbord: unknown key; did you mean onboard?"),
        (f"onboard: {CONTROLLER}", "a mass of 1.06 +- 0.1 kg, not 4 and 1.325 kg"),
    ],
)
def test_what_is_wrong_with_a_robot_is_one_problem_by_name(own_robot, text, message):
    model = find_robot("pelican").model.read_text().replace('mass="1.0"', 'mass="1.265"')
    mine = own_robot(text, model)
    with pytest.raises(BadInputError) as error:
        cloudrc.fly("hover", HOVER | {"world.robot": str(mine)})
    assert message in str(error.value)
