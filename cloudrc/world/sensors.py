"""Add bias and seeded noise to the odometry that goes to cloud.

Guard and onboard controller use the true state, without errors.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from cloudrc.messages import ZERO, Odometry, Quaternion, Vector
from cloudrc.world.scene import mujoco


class Errors(NamedTuple):
    """Errors of a vector in any unit: white Gaussian noise and a constant bias, shape (3,).

    `noise` is the standard deviation per axis; `bias` and `noise` have the unit of the vector.
    """

    noise: float = 0.0
    bias: Vector = ZERO

    def add(self, true: Vector, rng: np.random.Generator) -> Vector:
        """Return the vector `true` plus these errors, shape (3,), any unit."""
        if self == NONE:
            return true
        (x, y, z), (bias_x, bias_y, bias_z) = true, self.bias
        more_x, more_y, more_z = rng.normal(0.0, self.noise, 3).tolist() if self.noise else ZERO
        return (x + bias_x + more_x, y + bias_y + more_y, z + bias_z + more_z)


NONE = Errors()


class Sensors:
    """Measure the robot's pose and twist for cloud, with errors."""

    def __init__(
        self,
        position_noise: float,
        velocity_noise: float,
        rng: np.random.Generator,
        attitude: Errors = NONE,
        rate: Errors = NONE,
        turn_rng: np.random.Generator | None = None,
    ) -> None:
        """Set the errors of the measured position, velocity, `attitude` and body `rate`.

        `position_noise` [m] and `velocity_noise` [m/s] are standard deviations per axis. The error
        of the attitude is a rotation about the body's axes. The noise of attitude and rate comes
        from `turn_rng`, so that it does not change the noise of position and velocity.
        """
        self._position, self._velocity = Errors(position_noise), Errors(velocity_noise)
        self._attitude, self._rate = attitude, rate
        self._rng, self._turn_rng = rng, turn_rng or rng
        self._exact = self._position == self._velocity == attitude == rate == NONE

    def measure(self, truth: Odometry) -> Odometry:
        """Return the odometry that cloud gets: the true odometry plus the configured errors."""
        if self._exact:
            return truth
        turn = self._attitude.add(ZERO, self._turn_rng)
        return truth._replace(
            position=self._position.add(truth.position, self._rng),
            velocity=self._velocity.add(truth.velocity, self._rng),
            orientation_wxyz=_turned(truth.orientation_wxyz, turn),
            angular_velocity_body=self._rate.add(truth.angular_velocity_body, self._turn_rng),
        )


def _turned(orientation_wxyz: Quaternion, turn: Vector) -> Quaternion:
    """Turn an orientation by the rotation vector `turn` [rad], body frame, shape (3,)."""
    if turn == ZERO:
        return orientation_wxyz
    quaternion = np.array(orientation_wxyz)
    mujoco.mju_quatIntegrate(quaternion, np.array(turn), 1.0)
    w, x, y, z = quaternion.tolist()
    return (w, x, y, z)
