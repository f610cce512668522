"""An onboard controller that fails: the robot stops, the verdict names file and line."""

import pytest

import cloudrc
from cloudrc.config.robot import find_robot
from cloudrc.errors import BadInputError
from cloudrc.messages import GuardState
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
from cloudrc.sim.onboard import Accelerator
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
def own(tmp_path):
    """Return a function that writes an x2 with an onboard controller of one's own."""
    model = find_robot("x2").model.read_text()

    def write(source):
        (tmp_path / "robot.xml").write_text(model)
        (tmp_path / "robot.yaml").write_text("onboard: ./own.py")
        (tmp_path / "own.py").write_text(source)

    return write


@pytest.fixture
def fly(own, tmp_path):
    """Return a function that flies an x2 with an onboard controller of one's own."""

    def with_source(source, mission=HOVER):
        own(source)
        return cloudrc.fly("hover", mission | {"world.robot": str(tmp_path)})

    return with_source


@pytest.mark.parametrize(
    ("what", "shown"),
    [
        ("return (float('nan'), *commands[1:])", "its result at [0] is nan, not a finite number"),
        ("raise KeyError('gyro')", "KeyError: 'gyro', own.py:19 in update"),
    ],
)
def test_a_controller_that_fails_in_flight_ends_it_with_onboard_failed(fly, what, shown):
    flight = fly(FAILS.replace("{what}", what))
    assert (flight.verdict, flight.failures[0].code) == ("failure", "onboard_failed")
    text = flight.failures[0].text
    assert shown in text
    assert "own.py" in text
    assert flight["/guard"]["state"][-1] == GuardState.ESTOP
    assert [each.code for each in flight.failures] == ["onboard_failed"]


def test_the_actuators_of_a_robot_that_failed_push_nothing(fly):
    flight = fly(FAILS.replace("{what}", "raise ValueError"))
    truth = flight["/ground_truth"]
    falls = truth["velocity"][truth["stamp_ns"] > flight["/guard"]["stamp_ns"][-1], 2]
    assert falls[0] > falls[-1]
    assert falls[-1] < -0.3


@pytest.mark.parametrize(
    "what",
    ["return (0.0,) * 9", "1 / 0"],
)
def test_physics_of_actuators_that_fails_in_flight_is_onboard_failed_too(fly, what):
    late = f"if self.steps > 900: {what}"
    flight = fly(FAILS.replace("{what}", "pass") + ACTUATORS.replace("{what}", late))
    assert flight.failures[0].code == "onboard_failed"
    assert "own.py" in flight.failures[0].text


@pytest.mark.parametrize(
    ("what", "shown"),
    [
        ("1 / 0", "ZeroDivisionError: division by zero, own.py:14 in run"),
        ("data.qvel[0] = float('nan')", "its velocity at [0] is nan, not a finite number"),
    ],
)
def test_an_accelerator_that_fails_in_flight_ends_it_with_onboard_failed(
    fly, what, shown, tmp_path, monkeypatch
):
    monkeypatch.chdir(tmp_path)  # MuJoCo writes a file about values that are not finite
    flight = fly(FASTER.replace("{what}", what))
    assert [each.code for each in flight.failures].count("onboard_failed") == 1
    text = next(each.text for each in flight.failures if each.code == "onboard_failed")
    assert shown in text
    assert flight["/guard"]["state"][-1] == GuardState.ESTOP


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
