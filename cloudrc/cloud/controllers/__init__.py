"""Controllers compute velocity commands from the robot's estimated state and the setpoint.

Each controller is a plug-in in a file of its own. The file defines `build(**parameters)`, which
returns a `Controller`; all parameters are annotated.
"""

from __future__ import annotations

from typing import NamedTuple

from cloudrc.messages import ZERO, Odometry, Setpoint, Vector


class ControlOutput(NamedTuple):
    """The command of a controller, and the terms that make up its velocity.

    Attributes:
        velocity: Commanded velocity [m/s], world frame, shape (3,).
        yaw_rate: Commanded yaw rate [rad/s].
        proportional: Proportional term of the velocity [m/s], world frame, shape (3,).
        integral: Integral term of the velocity [m/s], world frame, shape (3,).
        derivative: Derivative term of the velocity [m/s], world frame, shape (3,).
    """

    velocity: Vector
    yaw_rate: float
    proportional: Vector = ZERO
    integral: Vector = ZERO
    derivative: Vector = ZERO


STAND_STILL = ControlOutput(ZERO, 0.0)


class Controller:
    """Computes the velocity commands that lead the robot to a setpoint."""

    def reset(self) -> None:
        """Reset the controller at the start of a session or mission."""

    def update(self, estimate: Odometry, setpoint: Setpoint, dt: float) -> ControlOutput:
        """Compute one command.

        Args:
            estimate: Predicted pose and twist of the robot, in the units and frames of `Odometry`.
            setpoint: Wanted position [m] and velocity [m/s], world frame, and yaw [rad].
            dt: Time since the last call [s], > 0.
        """
        raise NotImplementedError
