# SPDX-License-Identifier: Apache-2.0

"""Predictor: replay the sent commands through a first-order velocity loop.

Source: docs/reference/control.md, "Predictors", (e1).
"""

from __future__ import annotations

from bisect import bisect_right
from copy import copy
from math import ceil, exp
from pathlib import Path

from cloudrc.base.outside.document import read_document
from cloudrc.cloud.motion import Body
from cloudrc.cloud.predictors._history import COUNT, PERIOD_NS, Replay
from cloudrc.config.problems import validate
from cloudrc.config.robot import DEFAULT_LIMITS, Response, RobotFacts
from cloudrc.config.schema import Constants, DeadTimes, NotNegatives, Positive
from cloudrc.physics.geometry.vectors import step_towards
from cloudrc.wire.messages import ZERO, Command, Odometry, Vector

Axes = tuple[Vector, ...]
"""Time constant [s], dead time [s] and gain [1] of x, y and z."""
ACCELERATION_MAX = DEFAULT_LIMITS.acceleration_max_mps2
"""Acceleration limit of the model of an unknown robot [m/s^2]."""
STEPS_MAX = 200
"""Largest number of steps of the model from one command to the next."""


class FirstOrder(Body):
    """A model of the velocity loop behind the guard's acceleration limit.

    Each axis has two first-order lags in series: one for the dead time, one for the velocity.
    """

    def __init__(self, axes: Axes, acceleration_max: float) -> None:
        """Begin at rest; `acceleration_max` [m/s^2] is the guard's acceleration limit."""
        self._axes, self._acceleration_max = axes, acceleration_max
        self._reference = self._delayed = self.velocity = self.position = ZERO

    def advance(self, command: Vector, dt: float) -> None:
        """Advance the state by `dt` [s] under a velocity command [m/s].

        The time is divided into steps of about one control period. Each step takes the reference
        as constant, and solves the equations of the lags exactly.
        """
        steps = min(ceil(dt * 1e9 / PERIOD_NS - 0.5), STEPS_MAX) or 1
        for _ in range(steps):
            self._step(command, dt / steps)

    def _step(self, command: Vector, dt: float) -> None:
        before = self._reference
        self._reference = step_towards(before, command, self._acceleration_max * dt)
        axes = []
        for a, b, late, v, p, (constant, dead, gain) in zip(
            before, self._reference, self._delayed, self.velocity, self.position, self._axes,
            strict=True,
        ):  # fmt: skip
            given = 0.5 * (a + b)
            rest = exp(-dt / dead) if dead else 0.0
            goal = gain * (given + (late - given) * (1.0 - rest) * dead / dt)  # mean of the step
            decay = exp(-dt / constant)
            way = goal * dt + (v - goal) * constant * (1.0 - decay)
            axes.append((given + (late - given) * rest, goal + (v - goal) * decay, p + way))
        self._delayed, self.velocity, self.position = zip(*axes, strict=True)


class CommandHistory(Replay):
    """Adds the effect of the commands during the horizon to the measured position and velocity.

    The velocity loop is linear, except for the acceleration limit at its input. Therefore the
    difference between measured and simulated velocity decays exponentially, and one simulation of
    all commands, from rest, is enough.
    """

    def __init__(self, axes: Axes, acceleration_max: float) -> None:
        """Set `axes` and acceleration limit `acceleration_max` [m/s^2] of the velocity loop."""
        self._axes, self._loop = axes, (axes, acceleration_max)
        super().__init__()

    def reset(self) -> None:
        """Forget all samples, commands and echoes."""
        super().reset()
        self._bodies: list[FirstOrder] = []  # at the stamp of each command

    def commanded(self, command: Command) -> None:
        """Store a command, and the state of the predictor's model at the command's stamp."""
        body = self._at(command.stamp_ns)
        super().commanded(command)
        if len(self._bodies) != len(self.stamps):  # it is stored
            if len(self._bodies) > len(self.stamps):  # the oldest are forgotten
                del self._bodies[:COUNT]
            self._bodies.append(body)

    def _at(self, time_ns: int) -> FirstOrder:
        """Return the predictor's model of the robot at `time_ns`, on cloud's clock [ns]."""
        if not self.stamps:
            return FirstOrder(*self._loop)
        index = max(bisect_right(self.stamps, time_ns) - 1, 0)
        body, since_ns = copy(self._bodies[index]), self.commands[index].planned_ns
        end_ns = since_ns + time_ns - self.stamps[index]
        for velocity, duration in self.followed(index + 1, since_ns, end_ns):
            if duration > 0.0:
                body.advance(velocity, duration)
        return body

    def roll(self, odometry: Odometry, horizon: float) -> FirstOrder:
        """Return the model in its predicted state, `horizon` [s] after the sample `odometry`."""
        start_ns = odometry.stamp_ns - self.shift_ns(odometry, horizon)
        start, body = self._at(start_ns), self._at(start_ns + round(horizon * 1e9))
        axes = []
        for v, p, v0, p0, v1, p1, (constant, _, _) in zip(
            odometry.velocity, odometry.position, start.velocity, start.position,
            body.velocity, body.position, self._axes, strict=True,
        ):  # fmt: skip
            decay = exp(-horizon / constant)
            axes.append((v1 + (v - v0) * decay, p + p1 - p0 + (v - v0) * constant * (1.0 - decay)))
        body.velocity, body.position = zip(*axes, strict=True)
        body.basis, body.horizon = odometry, horizon
        return body


def build(
    time_constant: Constants | None = None,
    dead_time: DeadTimes | None = None,
    gain: NotNegatives | None = None,
    acceleration_max: Positive | None = None,
    model: Path | None = None,
    *,
    robot: RobotFacts | None = None,
) -> CommandHistory:
    """Make the predictor; what is not given is the robot's, from `response` in its robot.yaml.

    Args:
        time_constant: Time constant of the velocity loop per axis [s], shape (3,).
        dead_time: Time until the robot reacts to a command, per axis [s], shape (3,).
        gain: Velocity per commanded velocity, per axis [1], shape (3,).
        acceleration_max: Acceleration limit of the model [m/s^2]; null: that of the guard.
        model: File from `cloudrc identify`, whose values replace the first three parameters.
        robot: What is known of the robot.

    Raises:
        ValueError: If neither robot nor parameters tell the response.
        CloudrcError: If the file is no model.
    """
    response = robot.response if robot else None
    given = {"time_constant": time_constant, "dead_time": dead_time, "gain": gain}
    if model is not None:
        given = {}
        response = validate(read_document(Path(model), str(model)), Response, str(model))
    found = [given.get(name) or getattr(response, name, None) for name in Response.model_fields]
    if None in found:
        raise ValueError(
            f"the robot {robot.name if robot else 'is unknown and'} has no response in its "
            "robot.yaml; measure it with 'cloudrc identify', or choose a predictor without a model"
        )
    limit = acceleration_max or (robot.acceleration_max if robot else ACCELERATION_MAX)
    return CommandHistory(tuple(zip(*found, strict=True)), limit)
