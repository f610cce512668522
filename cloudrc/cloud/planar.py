"""Controller of a robot that stays on the ground."""

from __future__ import annotations

from cloudrc.cloud.controllers import Controller, ControlOutput
from cloudrc.cloud.results import check_output
from cloudrc.messages import Odometry, Setpoint


class Planar(Controller):
    """A controller whose commands have no vertical velocity."""

    def __init__(self, controller: Controller) -> None:
        """Take the horizontal velocity and the yaw rate from `controller`."""
        self._controller = controller

    def reset(self) -> None:
        """Reset the controller."""
        self._controller.reset()

    def update(self, estimate: Odometry, setpoint: Setpoint, dt: float) -> ControlOutput:
        """Compute one command, as the controller does after `dt` [s], without a velocity in z."""
        output = check_output(self._controller.update(estimate, setpoint, dt))
        x, y, _ = output.velocity
        return output._replace(velocity=(x, y, 0.0))
