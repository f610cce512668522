"""Controller of a robot that stays on the ground."""

from __future__ import annotations

from cloudrc.cloud.controllers import Controller, ControlOutput
from cloudrc.cloud.controllers.remote import STAND_STILL, OutsideController
from cloudrc.cloud.results import check_output
from cloudrc.errors import ControllerLostError
from cloudrc.messages import Odometry, Setpoint
from cloudrc.outside.values import InvalidValueError
from cloudrc.records import CONTROLLER_LOST

ROUNDING = 1e-9
"""Largest vertical velocity that counts as 0 [m/s]."""


class Planar(Controller):
    """Lets a controller see and steer the plane alone, and refuses its vertical velocities."""

    def __init__(self, controller: Controller, name: str, robot: str) -> None:
        """Wrap `controller`; errors call it `name`, and the robot `robot`."""
        self._controller, self._name, self._robot = controller, name, robot
        self._lost = False

    def reset(self) -> None:
        """Reset the controller."""
        self._controller.reset()

    def update(self, estimate: Odometry, setpoint: Setpoint, dt: float) -> ControlOutput:
        """Compute one command, as the controller does after `dt` [s].

        The controller sees the robot at the height of the setpoint, without vertical velocities. So
        one that steers by the error of the position commands no vertical velocity.

        Raises:
            InvalidValueError: If the controller commands a vertical velocity.
            ControllerLostError: Once, if a program outside does so.
        """
        if self._lost:
            return STAND_STILL
        x, y, _ = estimate.position
        vx, vy, _ = estimate.velocity
        level = estimate._replace(position=(x, y, setpoint.position[2]), velocity=(vx, vy, 0.0))
        rx, ry, rz = setpoint.velocity
        if rz:
            setpoint = setpoint._replace(velocity=(rx, ry, 0.0))
        output = check_output(self._controller.update(level, setpoint, dt))
        x, y, z = output.velocity
        if abs(z) > ROUNDING:
            self._refuse(z)
        return output._replace(velocity=(x, y, 0.0))

    def _refuse(self, z: float) -> None:
        text = f"its velocity in z is {z:.4g} m/s, but {self._robot} stays on the ground: give 0"
        if isinstance(self._controller, OutsideController):
            self._lost = True
            _, invalid = CONTROLLER_LOST
            place = self._controller.place or self._name  # ROS without a namespace has no place
            raise ControllerLostError(invalid, f"{place}: {text}")
        raise InvalidValueError(f"{self._name}: {text}")
