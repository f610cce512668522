# SPDX-License-Identifier: Apache-2.0

"""Controller of a robot that stays on the ground."""

from __future__ import annotations

from typing import Any

import numpy as np

from cloudrc.base.errors import ControllerLostError
from cloudrc.base.outside.values import InvalidValueError
from cloudrc.cloud.controllers import Controller, ControlOutput, Goals, Planned
from cloudrc.cloud.controllers.remote import OutsideController
from cloudrc.cloud.predictors import Model
from cloudrc.cloud.results import check_output, is_ours
from cloudrc.wire.messages import Odometry, Setpoint
from cloudrc.wire.records import CONTROLLER_LOST

ROUNDING = 1e-9
"""Largest vertical velocity that counts as 0 [m/s]."""


class Planar(Controller):
    """Lets a controller see and steer the plane alone; a vertical velocity is a failure."""

    def __init__(self, controller: Controller, name: str) -> None:
        """Wrap `controller`; errors call it `name`."""
        self._controller, self._name = controller, name
        self.is_foreign = not is_ours(controller)
        self._ask_plan: Any = getattr(controller, "plan", None)
        if self._ask_plan:
            self.plan = self._plan_level

    def reset(self) -> None:
        """Reset the controller."""
        self._controller.reset()

    def _plan_level(self, model: Model, goals: Goals, dt: float) -> Planned:
        """Let the controller plan; leave out vertical velocities. `dt` is as for `update` [s]."""
        velocities, positions, yaw_rate = self._ask_plan(model, goals, dt)
        return Planned(np.multiply(velocities, (1.0, 1.0, 0.0)), positions, yaw_rate)

    def update(self, estimate: Odometry, setpoint: Setpoint, dt: float) -> ControlOutput | None:
        """Compute one command, as the controller does after `dt` [s].

        The controller sees the robot at the height of the setpoint, without vertical velocities. So
        one that steers by the error of the position commands no vertical velocity.

        Raises:
            InvalidValueError: If the controller commands a vertical velocity.
            ControllerLostError: If a program outside does so.
        """
        stamp_ns, (x, y, _), orientation, (vx, vy, _), rate = estimate
        height = setpoint.position[2]
        level = Odometry(stamp_ns, (x, y, height), orientation, (vx, vy, 0.0), rate)
        rx, ry, _ = setpoint.velocity
        if setpoint.velocity[2]:
            setpoint = setpoint._replace(velocity=(rx, ry, 0.0))
        output = self._controller.update(level, setpoint, dt)
        if output is None:
            return None
        if self.is_foreign:
            output = check_output(output)
        x, y, z = output.velocity
        if abs(z) <= ROUNDING:
            return ControlOutput((x, y, 0.0), *output[1:])
        text = f"{self._name}: its velocity in z is {z:.4g} m/s, but the robot stays on the ground"
        if isinstance(self._controller, OutsideController):
            raise ControllerLostError(CONTROLLER_LOST[1], text)
        raise InvalidValueError(text)
