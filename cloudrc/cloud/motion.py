# SPDX-License-Identifier: Apache-2.0

"""Models of a robot's motion under velocity commands, with which predictors replay commands."""

from __future__ import annotations

from cloudrc.cloud.predictors import Model, moved
from cloudrc.messages import Odometry, Vector


class Body(Model):
    """A model of the robot, in the state predicted for `horizon` [s] after the sample `basis`.

    `position` [m] and `velocity` [m/s] are those of the base, world frame.
    """

    basis: Odometry
    horizon: float
    position: Vector
    velocity: Vector

    def advance(self, command: Vector, dt: float) -> None:
        """Advance the state by `dt` [s] under a velocity command [m/s]."""
        raise NotImplementedError

    def correct(self, odometry: Odometry) -> None:
        """Adopt the state of a new sample, to which the model has advanced by the commands."""
        raise NotImplementedError

    def step(self, velocity: Vector, dt: float) -> Odometry:
        """Advance by `dt` [s] under the command `velocity` [m/s], and return the state."""
        self.advance(velocity, dt)
        self.horizon += dt
        return self.odometry()

    def odometry(self) -> Odometry:
        """Return the predicted state; its orientation follows from a constant angular velocity."""
        return moved(self.basis, self.horizon, self.position, self.velocity)
