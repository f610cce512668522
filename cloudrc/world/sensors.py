"""Add seeded noise to the odometry that goes to cloud, at 100 Hz.

The onboard controller uses the true state, without noise.
"""

from __future__ import annotations

import numpy as np

from cloudrc.messages import Odometry, Vector


class Sensors:
    """Add white Gaussian noise, independent per axis and sample, to position and velocity."""

    def __init__(
        self, position_noise: float, velocity_noise: float, rng: np.random.Generator
    ) -> None:
        """Set the standard deviations per axis, `position_noise` [m] and `velocity_noise` [m/s]."""
        self._position_noise, self._velocity_noise = position_noise, velocity_noise
        self._rng = rng
        self._exact = position_noise == velocity_noise == 0.0

    def measure(self, truth: Odometry) -> Odometry:
        """Return the odometry for cloud: the true odometry plus noise."""
        if self._exact:
            return truth
        return truth._replace(
            position=self._noisy(truth.position, self._position_noise),
            velocity=self._noisy(truth.velocity, self._velocity_noise),
        )

    def _noisy(self, true: Vector, deviation: float) -> Vector:
        if deviation == 0.0:
            return true
        x, y, z = true
        noise_x, noise_y, noise_z = self._rng.normal(0.0, deviation, 3).tolist()
        return (x + noise_x, y + noise_y, z + noise_z)
