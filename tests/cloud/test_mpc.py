# SPDX-License-Identifier: Apache-2.0

"""Model predictive control: its optimum, its limits and its prediction."""

import sys
from copy import copy
from dataclasses import replace

import numpy as np
import pytest

from cloudrc.base.errors import MissingPrerequisiteError
from cloudrc.cloud.controllers.mpc import build
from cloudrc.cloud.planar import Planar
from cloudrc.cloud.predictors.command_history import FirstOrder
from cloudrc.config.load import load_experiment
from cloudrc.config.robot import Response, RobotFacts
from cloudrc.wire.messages import UPRIGHT, ZERO, Odometry, Setpoint

SPEED, ACCELERATION = 2.0, 4.0
RESPONSE = Response(time_constant=(0.2,) * 3, dead_time=(0.1,) * 3, gain=(1.0,) * 3)
ROBOT = RobotFacts("mine", RESPONSE, None, ACCELERATION, SPEED)


def body():
    """Return a model that is what the controller expects of the robot, at rest at the origin."""
    model = FirstOrder(((0.2, 0.1, 1.0),) * 3, ACCELERATION)
    model.basis, model.horizon = Odometry(0, ZERO, UPRIGHT, ZERO, ZERO), 0.0
    return model


def follow(controller, path, seconds):
    """Fly behind `path`, a function of time; return rows of setpoint, position and command."""
    robot, rows = body(), []
    for k in range(round(seconds * 100)):
        plan = controller.plan(copy(robot), lambda ahead, now=0.01 * k: path(now + ahead), 0.01)
        rows.append((path(0.01 * k).position, robot.position, tuple(plan.velocities[0])))
        robot.advance(rows[-1][2], 0.01)
    return np.array(rows).transpose(1, 0, 2)


def test_it_follows_a_moving_setpoint_whose_future_it_knows():
    line = lambda time: Setpoint((time, -0.5 * time, 0.0), velocity=(1.0, -0.5, 0.0))  # noqa: E731
    setpoints, positions, _ = follow(build(robot=ROBOT), line, 3.0)
    assert np.abs(setpoints - positions)[-50:].max() < 1e-3
    turn = lambda time: Setpoint((min(time, 2.0), max(time - 2.0, 0.0), 0.0))  # noqa: E731
    _, _, commands = follow(build(robot=ROBOT), turn, 2.0)
    assert commands[-1, 1] > 0.1, "it turns before the setpoint does"


def test_a_step_keeps_to_the_limits_and_ends_without_overshoot():
    _, positions, commands = follow(build(robot=ROBOT), lambda _: Setpoint((4.0, 1.0, 0.0)), 4.5)
    changes = np.diff(np.vstack((np.zeros(3), commands)), axis=0)
    assert np.abs(commands).max() <= SPEED + 1e-6
    assert np.abs(changes).max() <= ACCELERATION * 0.01 + 1e-6
    assert np.abs(commands).max() > 0.9 * SPEED, "it uses what it has"
    assert positions[:, 0].max() < 4.02
    assert positions[-1] == pytest.approx((4.0, 1.0, 0.0), abs=0.01)


def test_its_plan_is_what_it_predicts():
    model, moved = body(), body()
    planned = build(robot=ROBOT).plan(model, lambda _: Setpoint((0.1, 0.0, 0.0)), 0.01)
    for velocity, position in zip(planned.velocities, planned.positions, strict=True):
        moved.advance(tuple(velocity), 0.01)
        assert tuple(position) == pytest.approx(moved.position, abs=5e-4)


def test_on_the_ground_its_plan_is_level():
    controller = Planar(build(robot=ROBOT), "mpc")
    planned = controller.plan(body(), lambda _: Setpoint((1.0, 0.0, 1.0)), 0.01)
    assert planned.velocities[:, 2].any() is np.False_
    assert planned.velocities[:, 0].all()


def test_without_daqp_or_response_one_line_says_what_to_do(monkeypatch):
    with pytest.raises(ValueError, match=r"no response in its robot\.yaml; measure it"):
        build(robot=replace(ROBOT, response=None))
    monkeypatch.setitem(sys.modules, "daqp", None)
    with pytest.raises(MissingPrerequisiteError, match=r"run: pip install 'cloudrc\[mpc\]'$"):
        load_experiment("steps", ["cloud.controller=mpc"])
