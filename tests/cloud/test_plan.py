# SPDX-License-Identifier: Apache-2.0

"""Plans: the controller's future commands, by the predictor's model and the future setpoints."""

from math import nan

import numpy as np
import pytest

from cloudrc.cloud.controllers import Controller, ControlOutput, Planned
from cloudrc.cloud.controllers.pid import build as pid
from cloudrc.cloud.predictors import Model
from cloudrc.cloud.predictors.last_sample import LastSample
from cloudrc.wire.messages import UPRIGHT, ZERO, Motion, Odometry, Setpoint
from tests.cloud.conftest import HERE, MS, Integrating, command, loop


class Obedient(Model):
    """A robot that has the commanded velocity at once."""

    def __init__(self, position):
        self.position = position

    def step(self, velocity, dt):
        self.position = tuple(p + v * dt for p, v in zip(self.position, velocity, strict=True))
        return Odometry(0, self.position, UPRIGHT, velocity, ZERO)


class Modelled(LastSample):
    def __init__(self, position=HERE):
        self.position = position

    def model(self):
        return Obedient(self.position)


def planning(predictor=None, controller=None):
    """Return a loop with plans of 50 ms, which has heard telemetry."""
    return loop(None, predictor or Modelled(), controller, heard_ms=1090, echo_ms=1000, plan=0.05)


def make_plan(controller, setpoint, velocity, now_ns, count):
    """Plan `count` commands for a robot at the origin."""
    a_loop = loop(None, Modelled(ZERO), controller, plan=0.01 * count)
    a_loop._look_ahead(setpoint, now_ns)
    return a_loop._plan(velocity, now_ns)[0]


def along_x(plan):
    return [velocity[0] for velocity in plan]


def test_a_plan_has_the_commands_for_the_future_setpoints():
    controller = pid(gain_p=(10.0, 1.0, 1.0))
    plan = make_plan(controller, Setpoint((1.0, 0.0, 0.0)), (10.0, 0.0, 0.0), 0, 3)
    assert along_x(plan) == pytest.approx([9.0, 8.1, 7.29])
    carrot = Setpoint((9.0, 0.0, 0.0), motion=Motion(ZERO, 0, 1.0, 100.0))
    plan = make_plan(pid(gain_p=(1e-9,) * 3), carrot, ZERO, -20 * MS, 4)
    assert along_x(plan) == pytest.approx([0.0, 0.0, 1.0, 1.0], abs=1e-6)


def test_a_plan_does_not_change_the_controller():
    class Memory(Controller):
        def __init__(self):
            self.seen = []

        def update(self, estimate, setpoint, dt):
            self.seen.append(estimate)
            return ControlOutput((float(len(self.seen)), 0.0, 0.0), 0.0)

    controller = Memory()
    assert along_x(make_plan(controller, Setpoint(ZERO), ZERO, 0, 3)) == [1.0, 2.0, 3.0]
    assert controller.seen == []


class Breaking(Integrating):
    """A controller whose third command is wrong."""

    def __init__(self, wrong):
        super().__init__()
        self.wrong = wrong

    def update(self, estimate, setpoint, dt):
        self.asked += 1
        return ControlOutput((1.0, self.wrong if self.asked == 3 else 0.0, 0.0), 0.0)


def test_a_plan_ends_before_a_velocity_that_the_guard_refuses():
    assert len(make_plan(Breaking(1000.1), Setpoint(ZERO), ZERO, 0, 9)) == 2


def test_a_command_has_the_plan_and_its_time():
    a_loop = planning()
    sent, control = command(a_loop, 1094)
    assert sent.planned_ns == 100 * MS + round(control.horizon * 1e9) == 190 * MS
    assert along_x(sent.plan) == pytest.approx([0.8 * 0.992**k for k in range(1, 6)])
    assert sent.velocity_at(221 * MS) == sent.plan[2]


def test_without_a_model_or_while_frozen_there_is_no_plan():
    assert command(planning(), 1600)[0][3:] == (ZERO, 0.0, (), -1)
    sent, _ = command(planning(LastSample()), 1094)
    assert (sent.plan, sent.planned_ns) == ((), -1)


class Broken(LastSample):
    def model(self):
        raise ZeroDivisionError


class Lost(Modelled):
    """A predictor whose model returns a wrong state."""

    def __init__(self, state):
        self.state = state

    def model(self):
        model = Model()
        model.step = lambda velocity, dt: self.state
        return model


NOWHERE = Odometry(0, (nan, 0.0, 0.0), UPRIGHT, ZERO, ZERO)


def turned(length):
    """Return a state whose orientation has this length."""
    return Odometry(0, ZERO, (0.0, 0.6 * length, 0.8 * length, 0.0), ZERO, ZERO)


@pytest.mark.parametrize(
    ("predictor", "controller", "kind", "text"),
    [
        (Broken(), Integrating(), "predictor", "in model"),
        (Modelled(), Breaking(nan), "controller", "its planned velocity at [1] is nan"),
        (Lost(NOWHERE), Integrating(), "predictor", "its position at [0] is nan"),
        (Lost(None), Integrating(), "predictor", "its result is None, not 5 values"),
        (Lost(turned(0.0)), Integrating(), "predictor", "has the length 0, not 1"),
        (Lost(turned(0.99)), Integrating(), "predictor", "has the length 0.99, not 1"),
        (Lost(turned(1.01)), Integrating(), "predictor", "has the length 1.01, not 1"),
    ],
)
def test_without_its_plan_a_command_leaves_and_a_fault_says_why(predictor, controller, kind, text):
    a_loop = planning(predictor, controller)
    sent, _ = command(a_loop, 1094)
    assert (sent.plan, sent.velocity) == ((), (1.0, 0.0, 0.0))
    assert a_loop.counts == {f"{kind}_failed": 1}
    for part in (text, "cloud sends this command without a plan", f"fix cloud.{kind}"):
        assert part in a_loop.faults[0].text


class Planning(Controller):
    """Plans rows of velocities, and climbs by `update`."""

    def __init__(self, velocities):
        self.velocities = velocities

    def plan(self, model, goals, dt):
        self.goal = goals(0.5)
        return Planned(self.velocities, np.arange(9.0).reshape(3, 3), 0.25)

    update = Integrating.update
    asked = 0


def test_cloud_sends_a_controllers_own_plan_and_remembers_its_positions():
    controller = Planning([(1.0, 0.0, 0.0), (2, 0, 0), (3.0, 0.0, 0.0), (2000.0, 0.0, 0.0)])
    a_loop = planning(None, controller)
    sent, _ = command(a_loop, 1094)
    assert (sent.velocity, sent.yaw_rate) == ((1.0, 0.0, 0.0), 0.25)
    assert sent.plan == ((2.0, 0.0, 0.0), (3.0, 0.0, 0.0)), "the guard refuses the last one"
    [(_, positions)] = a_loop.plans.plans.values()
    assert positions[1:] == [(0.0, 1.0, 2.0), (3.0, 4.0, 5.0), (6.0, 7.0, 8.0)]
    assert controller.goal.position == (2.0, 2.0, 3.0)
    sent, _ = command(loop(None, LastSample(), controller, heard_ms=1090, echo_ms=1000), 1094)
    assert controller.asked == 1, "without a model cloud calls update"


@pytest.mark.parametrize("wrong", [[(nan, 0.0, 0.0)], [(1.0, 2.0)], [], None])
def test_a_wrong_plan_is_a_failure(wrong):
    a_loop = planning(None, Planning(wrong))
    assert command(a_loop, 1094)[0].velocity == ZERO
    assert a_loop.counts == {"controller_failed": 1}


def test_a_controller_may_plan_nothing():
    controller = Planning([(1.0, 0.0, 0.0)])
    a_loop = planning(None, controller)
    assert command(a_loop, 1094)[0].velocity == (1.0, 0.0, 0.0)
    a_loop._plans_itself = lambda model, goals, dt: None
    sent, control = command(a_loop, 1104)
    assert (sent, control.command) == (None, (1.0, 0.0, 0.0))
    assert (a_loop.counts, controller.asked) == ({"commands_withheld": 1}, 0)


def test_a_plan_is_forgotten_while_cloud_stands_still():
    controller, seen = Planning([(1.0, 0.0, 0.0)]), []
    a_loop = planning(None, controller)
    controller.reset = lambda: seen.append(a_loop.counts["frozen"])
    for now_ms in (1094, 1400, 1700, 1710):
        command(a_loop, now_ms)
    assert seen == [1, 2]
