# SPDX-License-Identifier: Apache-2.0

"""A folder with a model and `onboard: multirotor` is a robot that flies in the testbed."""

from contextlib import nullcontext

import pytest

from cloudrc.base.errors import BadInputError
from cloudrc.config.load import load_experiment
from cloudrc.robots.build import build_robot
from cloudrc.robots.onboard._drag import RotorDrag
from tests.robots.onboard.conftest import nano, robot, x_layout

MODEL = nano().replace('pos="0 0 2"', "")
WEAK = robot(x_layout(0.14, 0.17, 0.02, 6.0), 1.3, ".03 .025 .05").replace('pos="0 0 2"', "")
"""Its thrust is 1.9 times its weight."""


def test_the_drag_of_robot_yaml_reaches_the_rotors(own_robot):
    mine = own_robot("onboard: {name: multirotor, drag_s_per_m: 0.02}", MODEL)
    experiment = load_experiment("hover", ["world.scene=empty", f"world.robot={mine}"])
    robot = build_robot(experiment.world, experiment.guard)
    assert isinstance(robot.simulator.actuators, RotorDrag)


@pytest.mark.parametrize(("braking", "error"), [(3, None), (10, BadInputError)])
def test_a_robot_that_cannot_brake_as_its_robot_yaml_says_is_refused(own_robot, braking, error):
    mine = own_robot(f"onboard: multirotor\nguard: {{braking_mps2: {braking}}}", WEAK)
    experiment = load_experiment("hover", ["world.scene=empty", f"world.robot={mine}"])
    text = r"with 10 m/s\^2 \(guard\.braking_mps2\)"
    with pytest.raises(error, match=text) if error else nullcontext():
        build_robot(experiment.world, experiment.guard)
