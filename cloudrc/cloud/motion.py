"""Models of a robot's motion under velocity commands, with which predictors replay commands."""

from __future__ import annotations

from cloudrc.cloud.predictors import Model, rotate_ahead
from cloudrc.messages import Odometry, Vector

_new = tuple.__new__  # makes a named tuple twice as fast as its class does


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
        _, _, orientation, _, rate = self.basis
        stamp_ns = self.basis.stamp_ns + round(self.horizon * 1e9)
        orientation = rotate_ahead(orientation, rate, self.horizon)
        return _new(Odometry, (stamp_ns, self.position, orientation, self.velocity, rate))
