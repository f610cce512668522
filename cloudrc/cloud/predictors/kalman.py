# SPDX-License-Identifier: Apache-2.0

"""Predictor: filter the odometry with a Kalman filter, then replay the sent commands.

The filter's model is that of `model_based` or of `command_history`. All axes have the same noise,
so one covariance of position and velocity is enough.

Source: docs/reference/control.md, "Predictors", (f).
"""

from __future__ import annotations

from functools import lru_cache
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from cloudrc.cloud.predictors import Model, Predictor
from cloudrc.cloud.predictors._history import Replay
from cloudrc.config.choice import PlugIn
from cloudrc.config.overrides import build_plugin
from cloudrc.config.robot import RobotFacts
from cloudrc.config.schema import Positive
from cloudrc.wire.messages import Command, Odometry

Array = NDArray[np.float64]
Rows = tuple[tuple[float, float], tuple[float, float]]
"""A covariance of position and velocity, row by row."""


class Kalman(Predictor):
    """Filters position and velocity, and gives the filtered samples to another predictor."""

    def __init__(self, replay: Replay, position: float, velocity: float, model: float) -> None:
        """Set `replay`, the predictor that replays the commands, and three standard deviations.

        `position` [m] and `velocity` [m/s] are for the measured values, per axis. `model` [m/s^2]
        is for the acceleration of the filter's model.
        """
        self._replay, self._error, self.is_foreign = replay, model * model, replay.is_foreign
        self._noise: Rows = ((position * position, 0.0), (0.0, velocity * velocity))
        self.reset()

    def reset(self) -> None:
        """Forget the estimate, all commands and echoes."""
        self._estimate: Odometry | None = None
        self._covariance = self._noise
        self._replay.reset()

    def commanded(self, command: Command) -> None:
        """Pass a sent command on to `replay`, the predictor that simulates the commands."""
        self._replay.commanded(command)

    def applied(self, command_stamp_ns: int, applied_ns: int) -> None:
        """Pass the time at which world applied a command on to `replay`."""
        self._replay.applied(command_stamp_ns, applied_ns)

    def observe(self, odometry: Odometry) -> None:
        """Update the estimated state with a new odometry sample."""
        before, forecast = self._estimate, self._replay.forecast(odometry.stamp_ns)
        estimate = odometry
        if before is None or forecast is None:
            self._covariance = self._noise
        else:
            dt = (odometry.stamp_ns - before.stamp_ns) * 1e-9
            gains, self._covariance = _update(self._covariance, dt, self._noise, self._error)
            model = np.array((forecast.position, forecast.velocity))
            measured = np.array((odometry.position, odometry.velocity))
            position, velocity = (model + gains @ (measured - model)).tolist()
            stamp_ns, _, orientation, _, rate = odometry
            estimate = Odometry(stamp_ns, tuple(position), orientation, tuple(velocity), rate)
        self._estimate = estimate
        self._replay.observe(estimate, forecast)

    def predict(self, odometry: Odometry, horizon: float) -> Odometry:
        """Filter the newest sample `odometry`; extrapolate the result by `horizon` [s].

        With a horizon of 0, return `odometry` without filtering.
        """
        if self._estimate is None or self._estimate.stamp_ns != odometry.stamp_ns:
            self.observe(odometry)
        assert self._estimate is not None
        prediction = self._replay.predict(self._estimate, horizon)
        return prediction if horizon else odometry

    def model(self) -> Model | None:
        """Return the robot's model in the last predicted state; None before any prediction."""
        return self._replay.model()


@lru_cache(maxsize=4096)  # telemetry comes in whole periods, so the covariance settles
def _update(before: Rows, dt: float, noise: Rows, error: float) -> tuple[Array, Rows]:
    """Advance a covariance by `dt` [s] and one sample; return the gains K, shape (2, 2), and it.

    `noise` is that of a sample, R; `error` is the variance q of the model's acceleration, which is
    constant during `dt` [m^2/s^4]. With the covariance P and F = (1 dt; 0 1):
        P = F P F' + q · (dt^2/2, dt)' (dt^2/2, dt);  K = P (P + R)^-1;  P = (1 - K) P.
    Source: R. E. Kalman, "A New Approach to Linear Filtering and Prediction Problems", 1960.
    """
    ahead, push = np.array(((1.0, dt), (0.0, 1.0))), np.array((0.5 * dt * dt, dt))
    covariance = ahead @ np.array(before) @ ahead.T + error * np.outer(push, push)
    gains: Array = covariance @ np.linalg.inv(covariance + np.array(noise))
    first, second = (covariance - gains @ covariance).tolist()
    return gains, (tuple(first), tuple(second))


def build(
    model: Literal["white_box", "first_order"] | None = None,
    parameters: dict[str, Any] | None = None,
    model_file: Path | None = None,
    position_noise: Positive = 0.005,
    velocity_noise: Positive = 0.02,
    acceleration_error: Positive = 0.5,
    *,
    robot: RobotFacts | None = None,
) -> Kalman:
    """Make the predictor; the default noise is that of a good motion capture system.

    Args:
        model: `white_box`, the model of the file `motion` in robot.yaml, or `first_order`, as in
            `command_history`; null: as in `model_based`, or first_order if there is a `model_file`.
        parameters: Parameters of this predictor; null: its defaults.
        model_file: File from `cloudrc identify`, for `first_order`.
        position_noise: Standard deviation of the measured position per axis [m].
        velocity_noise: Standard deviation of the measured velocity per axis [m/s].
        acceleration_error: Standard deviation of the model's acceleration [m/s^2]. A larger value
            trusts the odometry more.
        robot: What is known of the robot.

    Raises:
        ValueError: If `white_box` has a `model_file`, or `parameters` has the key name or model.
            Also if the robot has no such model.
    """
    given = parameters or {}
    if model == "white_box" and (model_file or robot is None or robot.motion is None):
        raise ValueError("model: white_box needs a robot with motion, and no model_file; omit it")
    if {"name", "model"} & given.keys():
        raise ValueError("parameters: choose the model beside them, with model or model_file")
    is_first_order = model == "first_order" or model_file is not None
    name = "command_history" if is_first_order else "model_based"
    if model_file is not None:
        given = {**given, "model": str(model_file)}
    choice = PlugIn.model_validate({**given, "name": name})
    replay = build_plugin("predictors", choice, robot=robot)
    return Kalman(replay, position_noise, velocity_noise, acceleration_error)
