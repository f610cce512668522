# SPDX-License-Identifier: Apache-2.0

"""Add bias and seeded noise to the odometry that goes to cloud.

Guard and onboard controller use the true state, without errors.
"""

from __future__ import annotations

from math import radians
from typing import NamedTuple

import numpy as np

from cloudrc.config import disturbances
from cloudrc.physics.sim.simulator import turned
from cloudrc.wire.messages import ZERO, Odometry, Vector


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
        more = rng.normal(0.0, self.noise, 3) if self.noise else ZERO
        x, y, z = (np.add(true, self.bias) + more).tolist()
        return (x, y, z)


NONE = Errors()


class Sensors:
    """Measure the robot's pose and twist for cloud, with errors.

    Attributes:
        exact: Whether there are no errors.
    """

    def __init__(
        self,
        errors: disturbances.SensorsConfig,
        rng: np.random.Generator,
        turn_rng: np.random.Generator,
    ) -> None:
        """Set the errors of the measured position, velocity, attitude and body rate.

        The noise of attitude and rate comes from `turn_rng`, so that it does not change the noise
        of position and velocity.
        """
        roll, pitch, yaw = map(radians, errors.attitude_bias_deg)
        self._position = Errors(errors.position_noise_m)
        self._velocity = Errors(errors.velocity_noise_mps)
        self._attitude = Errors(radians(errors.attitude_noise_deg), (roll, pitch, yaw))
        self._rate = Errors(errors.rate_noise_radps, errors.rate_bias_radps)
        self._rng, self._turn_rng = rng, turn_rng
        self.exact = errors == disturbances.SensorsConfig()

    def measure(self, truth: Odometry) -> Odometry:
        """Return the odometry that cloud gets: the true odometry plus the configured errors."""
        turn, orientation = self._attitude.add(ZERO, self._turn_rng), truth.orientation_wxyz
        return truth._replace(
            position=self._position.add(truth.position, self._rng),
            velocity=self._velocity.add(truth.velocity, self._rng),
            orientation_wxyz=orientation if turn == ZERO else turned(orientation, turn),
            angular_velocity_body=self._rate.add(truth.angular_velocity_body, self._turn_rng),
        )
