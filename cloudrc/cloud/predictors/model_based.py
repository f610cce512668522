# SPDX-License-Identifier: Apache-2.0

"""Predictor: replay the sent commands through the best model of the robot.

The best model is that of the file `motion` in its robot.yaml, which may contain the onboard
controller and the forces on the robot. Each odometry sample corrects this model. A robot without
this file has a first-order model, `response`, as in `command_history`.

Source: docs/reference/control.md, "Predictors", (e2).
"""

from __future__ import annotations

from collections.abc import Callable
from copy import copy
from typing import Any

from cloudrc.base import plugins
from cloudrc.cloud.motion import Body
from cloudrc.cloud.predictors import command_history
from cloudrc.cloud.predictors._history import Replay
from cloudrc.config.choice import PlugIn
from cloudrc.config.overrides import build_plugin
from cloudrc.config.robot import RobotFacts
from cloudrc.config.schema import Positive
from cloudrc.wire.messages import Odometry

GAP_NS = 500_000_000
"""Time without odometry after which the model starts again [ns]."""


class ModelBased(Replay):
    """Simulates a model of the robot from the newest odometry to the horizon."""

    def __init__(self, start: Callable[[Odometry], Body], *, is_foreign: bool) -> None:
        """Set the function that starts a model in a measured state; a user's file `is_foreign`."""
        self._start, self.is_foreign = start, is_foreign
        super().__init__()

    def reset(self) -> None:
        """Forget all samples, commands and echoes."""
        super().reset()
        self._body: Body | None = None  # at the newest sample

    def forecast(self, stamp_ns: int) -> Body | None:
        """Predict the model's state at `stamp_ns` [ns]; None without recent odometry or command."""
        body = copy(self._body)
        if body is None or not 0 < stamp_ns - body.basis.stamp_ns < GAP_NS:
            return None
        if self.is_silent(stamp_ns):  # the guard holds the robot
            return None
        body.replay(self.past(body.basis.stamp_ns, stamp_ns))
        return body

    def observe(self, odometry: Odometry, forecast: Body | None = None) -> None:
        """Correct the model of the robot with a new sample; `forecast` is that for its stamp."""
        super().observe(odometry)
        self._body = forecast or self.forecast(odometry.stamp_ns) or self._start(odometry)
        self._body.correct(odometry)

    def roll(self, odometry: Odometry, horizon: float) -> Body:
        """Return the model in its predicted state, `horizon` [s] after the sample `odometry`."""
        if self._body is None or self._body.basis.stamp_ns != odometry.stamp_ns:
            self.observe(odometry)
        assert self._body is not None
        body = copy(self._body)
        start_ns, shift_ns = odometry.stamp_ns, self.shift_ns(odometry, horizon)
        end_ns = start_ns + round(horizon * 1e9)
        body.replay(self.ahead(start_ns, end_ns, shift_ns))
        body.horizon = horizon
        return body


def build(
    acceleration_max: Positive | None = None,
    *,
    robot: RobotFacts | None = None,
    **onboard: Any,
) -> Replay:
    """Make the predictor; the model is that of the robot.

    Args:
        acceleration_max: Acceleration limit of the model [m/s^2]; null: that of the guard.
        robot: What is known of the robot.
        **onboard: Parameters of the onboard controller, such as `gain_p`, which the model then
            assumes in place of those in robot.yaml, `world.tuning` and `world.onboard`.

    Raises:
        ValueError: If the robot has no model, but parameters of one are given.
    """
    if robot is None or robot.motion is None:
        if onboard:
            name = robot.name if robot else "a robot"
            raise ValueError(
                f"{', '.join(onboard)}: {name} has no model with parameters of the onboard "
                "controller (motion in robot.yaml), so only acceleration_max is known here"
            )
        return command_history.build(acceleration_max=acceleration_max, robot=robot)
    given = {**(robot.motion.model_extra or {}), **onboard}
    given["acceleration_max"] = acceleration_max or robot.acceleration_max
    choice = PlugIn.model_validate({**given, "name": robot.motion.name})
    is_foreign = not plugins.is_shipped("motion", choice.name)
    return ModelBased(build_plugin("motion", choice), is_foreign=is_foreign)
