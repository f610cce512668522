# SPDX-License-Identifier: Apache-2.0

"""Controller: model predictive control, whose plan is the optimum over the next 0.8 s.

Source: C. Cutler, B. Ramaker, "Dynamic matrix control: a computer control algorithm", 1980; the
plan as the answer over a lossy link: D. Quevedo, D. Nesic, "Input-to-state stability of packetized
predictive control over unreliable networks affected by packet-dropouts", IEEE TAC 56 (2), 2011.
"""

from __future__ import annotations

from collections.abc import Iterable
from itertools import chain
from math import inf, sqrt
from operator import attrgetter
from typing import Any

import numpy as np

from cloudrc.base.errors import MissingPrerequisiteError
from cloudrc.cloud.controllers import Controller, ControlOutput, Goals, Planned
from cloudrc.cloud.controllers.pid import GAIN_YAW
from cloudrc.cloud.motion import Body
from cloudrc.cloud.predictors import Model, rotate_ahead
from cloudrc.cloud.predictors.command_history import Axes, FirstOrder
from cloudrc.config.robot import RobotFacts
from cloudrc.config.schema import NotNegative, Positive
from cloudrc.physics.geometry.vectors import turn_to
from cloudrc.wire.messages import PLAN_STEP_NS, Odometry, Quaternion, Setpoint, Vector

STEP = PLAN_STEP_NS * 1e-9
"""Time between two velocities of a plan [s]."""
LOOK = 2 * STEP
"""Time between two predicted states [s]: half of the states take less time, and are enough."""
AHEAD = 40
"""Number of predicted states."""
TIMES: list[float] = (LOOK * np.arange(1, AHEAD + 1)).tolist()
"""Times from now to the predicted states [s]."""
MOVES = 40
"""Number of steps in which the command may change; then it is constant."""
ACCELERATION_MAX = 6.0
"""Largest acceleration that is planned [m/s^2]. At a tilt of 35 degrees a multirotor has 6.9; a
guard that allows more does not make it faster, but the plan unstable."""
BRAKING = 0.5
"""Share of the acceleration with which the robot shall brake at a setpoint [1]."""
NEAR = 0.15
"""Time constant with which the last part of the distance from a setpoint falls [s]."""
SETTLED = 1.0
"""Time after which the lags of a robot that has a steady command are over [s]."""
ROUNDING = 1e-9
"""Part of a limit by which a rounded value may exceed it [1]."""
WHERE = attrgetter("position", "velocity")
"""What counts of a setpoint."""


class Mpc(Controller):
    """Model predictive control of the position, by dynamic matrix control.

    The free response is that of the predictor's model under the last velocity. Each change of the
    command adds the step response of `response`. Per axis, the changes minimise the sum of squares
    over the horizon: position error, velocity error and changes, with their weights. The guard's
    limits of speed and acceleration are constraints on each axis.

    The optimum without constraints is one product of a matrix and a vector. A quadratic program is
    solved only if this optimum breaks a constraint.
    """

    def __init__(
        self, axes: Axes, speed: float, acceleration: float, follow: float, smooth: float, qp: Any
    ) -> None:
        """Set the response of each axis, and the guard's limits of `speed` and `acceleration`.

        `speed` is in [m/s], `acceleration` in [m/s^2]. `follow` is the weight of velocity errors
        [s^2], `smooth` that of changes of the command [s^2]. `qp` solves quadratic programs.
        """
        self._loop, self._solve = (axes, acceleration), qp
        self._speed, self._acceleration, self._change = speed, acceleration, acceleration * STEP
        self._sums = np.tril(np.ones((MOVES, MOVES)))
        # Effect of each change on position [s] and velocity [1], shape (3, AHEAD, MOVES).
        self._position, self._velocity = _responses(axes)
        effect = np.concatenate((self._position, follow * self._velocity), axis=1)
        both = np.concatenate((self._position, self._velocity), axis=1)
        effect = effect.transpose(0, 2, 1)
        self._cost = effect @ both + smooth * np.eye(MOVES)
        self._best = np.linalg.solve(self._cost, effect)  # errors -> changes
        self.reset()

    def reset(self) -> None:
        """Forget the last plan at the start of a session or mission."""
        self._last = np.zeros((1, 3))

    def update(self, estimate: Odometry, setpoint: Setpoint, dt: float) -> ControlOutput:
        """Compute one command for a predictor without a model: the robot is its `response`.

        `dt` is the time since the last command [s].
        """
        body = FirstOrder(*self._loop)
        body.advance(self._present(dt), SETTLED)
        body.basis, body.horizon = estimate, 0.0
        body.position, body.velocity = estimate.position, estimate.velocity
        planned = self.plan(body, lambda _: setpoint, dt)
        x, y, z = self._last[0].tolist()
        return ControlOutput((x, y, z), planned.yaw_rate)

    def plan(self, model: Model, goals: Goals, dt: float) -> Planned:
        """Compute the velocities from now on; `dt` is the time since the last command [s]."""
        present = self._present(dt)
        states, orientation = _coast(model, present)
        first, yaw_rate = goals(0.0), 0.0
        if first.turns:
            yaw_rate = GAIN_YAW * turn_to(first.yaw, orientation)
        positions, velocities = states[:, :3], states[:, 3:]
        wanted, speeds = self._approach(positions[0], goals)
        errors = np.concatenate((wanted - positions, speeds - velocities))
        changes, moves = self._optimum(errors.T[:, :, None], np.array(present)[:, None])
        commands = np.empty((2 * AHEAD, 3))
        commands[:MOVES] = moves.T
        commands[MOVES:] = commands[MOVES - 1]
        self._last = commands
        positions += (self._position @ changes[:, :, None])[:, :, 0].T
        velocities += (self._velocity @ changes[:, :, None])[:, :, 0].T
        every = np.empty((2 * AHEAD, 3))
        every[::2], every[1::2] = positions - STEP * velocities, positions
        return Planned(commands, every, yaw_rate)

    def _present(self, dt: float) -> Vector:
        """Return the velocity of the last plan after `dt` [s]: the robot follows it now [m/s]."""
        x, y, z = self._last[min(max(round(dt / STEP), 1), len(self._last)) - 1].tolist()
        return x, y, z

    def _approach(self, position: Any, goals: Goals) -> tuple[Any, Any]:
        """Return wanted positions [m] and velocities [m/s], shape (AHEAD, 3).

        They follow the setpoint. The present distance from it falls along a line, at the guard's
        speed, then with constant braking, at last exponentially: an optimum over 0.8 s does not
        know that the robot has to brake later.
        """
        at, moving = _where([goals(time) for time in TIMES])
        away = position - at[0]
        left = distance = sqrt(float(away @ away))
        braking, rests, speeds = BRAKING * self._acceleration, [], []
        most = self._speed
        near = braking * NEAR**2  # in this distance the speed falls with the distance [m]
        for _ in range(AHEAD):
            speed = left / NEAR if left <= near else sqrt(braking * (2.0 * left - near))
            if speed > most:
                speed = most
            speeds.append(speed)
            rests.append(left)
            left -= speed * LOOK
        way = away / (distance or 1.0)
        return at + np.array(rests)[:, None] * way, moving - np.array(speeds)[:, None] * way

    def _optimum(self, errors: Any, present: Any) -> tuple[Any, Any]:
        """Return the best changes of the command, and the commands [m/s], shapes (3, MOVES).

        `errors` are those of the free response in position [m] and velocity [m/s], shape
        (3, 2 AHEAD, 1). `present` is the present command [m/s], shape (3, 1).
        """
        changes = (self._best @ errors)[:, :, 0]
        commands, most = present + changes.cumsum(axis=1), 1.0 + ROUNDING
        too_far = abs(commands).max(axis=1) > self._speed * most
        too_fast = abs(changes).max(axis=1) > self._change * most
        breaks = too_far | too_fast
        if not breaks.any():
            return changes, commands
        ones = np.ones(MOVES)
        for axis in breaks.nonzero()[0].tolist():
            most_change, now = self._change * ones, present[axis] * ones
            low = np.concatenate((-most_change, -self._speed - now))
            high = np.concatenate((most_change, self._speed - now))
            cost = self._cost[axis]
            changes[axis] = self._solve(cost, -cost @ changes[axis], self._sums, high, low)[0]
        return changes, present + changes.cumsum(axis=1)


def _where(setpoints: Iterable[Setpoint]) -> tuple[Any, Any]:
    """Return positions [m] and velocities [m/s] of AHEAD setpoints, both of shape (AHEAD, 3)."""
    numbers = chain.from_iterable(chain.from_iterable(map(WHERE, setpoints)))
    rows = np.fromiter(numbers, float, 6 * AHEAD).reshape(AHEAD, 6)
    return rows[:, :3], rows[:, 3:]


def _coast(model: Model, velocity: Vector) -> tuple[Any, Quaternion]:
    """Return positions [m] and velocities [m/s] under one command [m/s], shape (AHEAD, 6).

    Also return the orientation in the first of these states.
    """
    if isinstance(model, Body):
        _, _, orientation, _, rate = model.basis
        orientation = rotate_ahead(orientation, rate, model.horizon + LOOK)
        states = np.frombuffer(model.coast(velocity, LOOK, AHEAD)).reshape(AHEAD, 6)
        return states, orientation
    found = [model.step(velocity, LOOK) for _ in range(AHEAD)]
    states = np.array([(*state.position, *state.velocity) for state in found])
    return states, found[0].orientation_wxyz


def _responses(axes: Axes) -> Any:
    """Compute the responses to a change by 1 m/s in each step.

    Returns:
        Positions [m] and velocities [m/s], shape (2, 3, AHEAD, MOVES).
    """
    body, states = FirstOrder(axes, inf), list[tuple[Vector, Vector]]()
    for _ in range(2 * AHEAD):
        body.advance((1.0, 1.0, 1.0), STEP)
        states.append((body.position, body.velocity))
    since = np.arange(1, 2 * AHEAD, 2)[:, None] - np.arange(MOVES)
    return np.where(since >= 0, np.array(states).transpose(1, 2, 0)[:, :, since], 0.0)


def build(
    follow: NotNegative = 0.05, smooth: Positive = 2.0, *, robot: RobotFacts | None = None
) -> Mpc:
    """Make the controller.

    Args:
        follow: Weight of the squared errors of the velocity, relative to the position's [s^2].
        smooth: Weight of the squared changes of the command per 10 ms, likewise [s^2].
        robot: What is known of the robot.

    Raises:
        ValueError: If the robot's response is unknown.
        MissingPrerequisiteError: If the package daqp is missing.
    """
    if robot is None or robot.response is None:
        name = robot.name if robot else "is unknown and"
        text = f"the robot {name} has no response in its robot.yaml"
        raise ValueError(f"{text}; measure it with 'cloudrc identify'")
    try:
        import daqp
    except ImportError:
        text = "the controller mpc needs daqp (not installed); run: pip install 'cloudrc[mpc]'"
        raise MissingPrerequisiteError(text) from None
    response = robot.response
    axes = zip(response.time_constant, response.dead_time, response.gain, strict=True)
    limits = robot.speed_max, min(robot.acceleration_max, ACCELERATION_MAX)
    return Mpc(tuple(axes), *limits, follow, smooth, daqp.solve)
