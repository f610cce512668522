"""Controllers: estimate and setpoint become a velocity command; one file each.

A plug-in file has a `build(**parameters)` with annotated parameters that returns a `Controller`.
"""

from __future__ import annotations

from typing import NamedTuple

from cloudrc.messages import ZERO, Odometry, Setpoint, Vector


class ControlOutput(NamedTuple):
    """What a controller wants, and why.

    Attributes:
        velocity: [m/s], world frame, shape (3,).
        yaw_rate: [rad/s].
        proportional: Share of the velocity [m/s], shape (3,).
        integral: Likewise.
        derivative: Likewise.
    """

    velocity: Vector
    yaw_rate: float
    proportional: Vector = ZERO
    integral: Vector = ZERO
    derivative: Vector = ZERO


class Controller:
    """Tracks a setpoint."""

    def reset(self) -> None:
        """Forget everything: a new session or mission begins."""

    def update(self, estimate: Odometry, setpoint: Setpoint, dt: float) -> ControlOutput:
        """Compute one command.

        Args:
            estimate: Predicted state. Position [m], velocity [m/s], world frame.
            setpoint: Where to be. Position [m], yaw [rad].
            dt: Time since the last call [s], > 0.
        """
        raise NotImplementedError
