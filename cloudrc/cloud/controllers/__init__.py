# SPDX-License-Identifier: Apache-2.0

"""Controllers compute velocity commands from the robot's estimated state and the setpoint.

Each controller is a plug-in in a file of its own. The file defines `build(**parameters)`, which
returns a `Controller`; all parameters are annotated.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, NamedTuple

from cloudrc.wire.messages import ZERO, Odometry, Setpoint, Vector

if TYPE_CHECKING:
    from numpy.typing import ArrayLike

    from cloudrc.cloud.predictors import Model


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


class Planned(NamedTuple):
    """What a controller that plans by itself commands from now on, in steps of 10 ms.

    Attributes:
        velocities: Commanded velocities [m/s], world frame, shape (n, 3). The first one is the
            command; as many of the others as the experiment asks for are its plan.
        positions: Predicted position at the end of each step [m], world frame, shape (n, 3).
        yaw_rate: Commanded yaw rate [rad/s].
    """

    velocities: ArrayLike
    positions: ArrayLike
    yaw_rate: float = 0.0


Goals = Callable[[float], Setpoint]
"""Function that returns the setpoint after a time from now [s], >= 0."""
STAND_STILL = ControlOutput(ZERO, 0.0)


class Controller:
    """Computes the velocity commands that lead the robot to a setpoint.

    Attributes:
        plan: Optional method that plans all velocities at once: `plan(model, goals, dt)`. Cloud
            calls it in place of `update` if the predictor has a model of the robot. The model has
            the predicted state of the robot; `dt` is the time since the last call [s].
    """

    plan: Callable[[Model, Goals, float], Planned | None] | None = None

    def reset(self) -> None:
        """Reset the controller at the start of a session or mission."""

    def update(self, estimate: Odometry, setpoint: Setpoint, dt: float) -> ControlOutput | None:
        """Compute one command; None: send nothing, so that the robot follows the last one.

        Args:
            estimate: Predicted pose and twist of the robot, in the units and frames of `Odometry`.
            setpoint: Wanted position [m] and velocity [m/s], world frame, and yaw [rad].
            dt: Time since the last call [s], > 0.
        """
        raise NotImplementedError
