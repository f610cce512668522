# SPDX-License-Identifier: Apache-2.0

"""Predictor: extrapolate with the measured velocity.

Source: the paper, eqs. (2) and (3).
"""

from __future__ import annotations

from cloudrc.cloud.predictors import Predictor, moved
from cloudrc.wire.messages import Odometry


class ConstantVelocity(Predictor):
    """Predicts with the measured velocity; the orientation changes at the measured rate."""

    def predict(self, odometry: Odometry, horizon: float) -> Odometry:
        """Extrapolate a sample by `horizon`, tau [s]: p + v · tau; the velocity stays as measured.

        Source: the paper, eq. (3a), and eq. (3b) with a = 0, because the robot does not measure its
        acceleration.
        """
        px, py, pz = odometry.position
        vx, vy, vz = velocity = odometry.velocity
        position = (px + vx * horizon, py + vy * horizon, pz + vz * horizon)
        return moved(odometry, horizon, position, velocity)


build = ConstantVelocity
