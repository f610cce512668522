# SPDX-License-Identifier: Apache-2.0

"""An onboard controller that fails: the robot stops, the verdict names file and line."""

import pytest

import cloudrc
from cloudrc.base.errors import BadInputError
from cloudrc.config.robot import find_robot
from cloudrc.wire.messages import GuardState
from tests.robots.conftest import HOVER

FAILS = """
from cloudrc.robots.onboard.multirotor import build as general


class Fails:
    def __init__(self, law):
        self.law, self.stopped, self.calls = law, law.stopped, 0

    def reset(self):
        self.law.reset()

    def brake(self, readings, velocity):
        return self.law.brake(readings, velocity)

    def update(self, readings, velocity, yaw_rate):
        self.calls += 1
        commands = self.law.update(readings, velocity, yaw_rate)
        if self.calls == 700:
            {what}
        return commands


def build(model):
    return Fails(general(model))
"""
ACTUATORS = """

class Push:
    def __init__(self):
        self.speeds, self.steps = (0.0,) * 4, 0

    def reset(self):
        self.steps = 0

    def step(self, commands, readings):
        self.steps += 1
        {what}
        return (*commands, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0)


def actuators(model, dt):
    return Push()
"""

FASTER = """
from cloudrc.robots.onboard.multirotor import build
from cloudrc.physics.sim.onboard import Accelerator
from cloudrc.world.robot import Robot


class Faster(Robot):
    runs = 0

    def run(self, tick_ns, until_ns):
        self.runs += 1
        data, ended_ns = self.simulator.data, super().run(tick_ns, until_ns)
        if self.runs == 300:
            {what}
        return ended_ns


def accelerator():
    return Accelerator(Faster, "mine")
"""


@pytest.fixture
def fly(own_robot, monkeypatch):
    """Return a function that flies an x2 with an onboard controller of one's own."""

    def with_source(source):
        mine = own_robot("onboard: ./own.py", find_robot("x2").model.read_text())
        (mine / "own.py").write_text(source)
        monkeypatch.chdir(mine)  # MuJoCo writes a file about values that are not finite
        return cloudrc.fly("hover", HOVER | {"world.robot": str(mine)})

    return with_source


def in_actuators(what):
    late = f"if self.steps > 900: {what}"
    return FAILS.replace("{what}", "pass") + ACTUATORS.replace("{what}", late)


@pytest.mark.parametrize(
    ("source", "shown"),
    [
        (FAILS.replace("{what}", "return (float('nan'), *commands[1:])"),
         "its result at [0] is nan, not a finite number"),
        (FAILS.replace("{what}", "raise KeyError('gyro')"),
         "KeyError: 'gyro', own.py:19 in update"),
        (in_actuators("return (0.0,) * 9"), "own.py"),
        (in_actuators("1 / 0"), "own.py"),
        (FASTER.replace("{what}", "1 / 0"),
         "ZeroDivisionError: division by zero, own.py:14 in run"),
        (FASTER.replace("{what}", "data.qvel[0] = float('nan')"),
         "its velocity at [0] is nan, not a finite number"),
    ],
)  # fmt: skip
def test_a_part_that_fails_in_flight_ends_it_with_onboard_failed(fly, source, shown):
    flight = fly(source)
    assert (flight.verdict, flight.failures[0].code) == ("failure", "onboard_failed")
    assert [each.code for each in flight.failures] == ["onboard_failed"]
    assert shown in flight.failures[0].text
    assert "own.py" in flight.failures[0].text
    assert flight["/guard"]["state"][-1] == GuardState.ESTOP


def test_the_actuators_of_a_robot_that_failed_push_nothing(fly):
    flight = fly(FAILS.replace("{what}", "raise ValueError"))
    truth = flight["/ground_truth"]
    falls = truth["velocity"][truth["stamp_ns"] > flight["/guard"]["stamp_ns"][-1], 2]
    assert falls[0] > falls[-1]
    assert falls[-1] < -0.3


def test_an_accelerator_that_cannot_put_the_robot_on_the_ground_fails_as_a_users_code(fly):
    fails = "    def put_on_ground(self, *why):\n        {}['spawn']\n\n    def run("
    flight = fly(FASTER.replace("{what}", "pass").replace("    def run(", fails))
    assert flight.failures[0].code == "onboard_failed"
    assert "KeyError: 'spawn', own.py:11 in put_on_ground" in flight.failures[0].text


def test_an_accelerator_that_holds_the_contract_flies_as_without_it(fly):
    faster = FASTER.replace("{what}", "pass")
    plain = faster.replace("def accelerator", "def _unused")
    assert fly(faster)["/ground_truth"]["position"].tolist() == (
        fly(plain)["/ground_truth"]["position"].tolist()
    )


def test_a_controller_without_its_parts_is_refused_before_the_flight(fly):
    with pytest.raises(BadInputError, match=r"/own\.py: .*'Fails' object has no attribute 'brake'"):
        fly(FAILS.replace("{what}", "pass").replace("def brake", "def halt"))
