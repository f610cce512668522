# SPDX-License-Identifier: Apache-2.0

"""Predictor: continues with the measured velocity, which fades with time.

Positions are in m, velocities in m/s, times in s; all vectors are in the world frame.
Source: integral of v exp(-t / T) from 0 to h: v T (1 - exp(-h / T)).
"""

from math import exp

from cloudrc.plugin import Odometry, Predictor, rotate_ahead


class Fading(Predictor):
    """Lets the robot coast: its velocity falls with a time constant [s]."""

    def __init__(self, time_constant: float) -> None:
        self.time_constant = time_constant

    def predict(self, odometry: Odometry, horizon: float) -> Odometry:
        """Return where the robot is, and how it moves, `horizon` [s] later."""
        left = exp(-horizon / self.time_constant)
        ahead = self.time_constant * (1.0 - left)  # [s] at the measured velocity
        x, y, z = odometry.position
        vx, vy, vz = odometry.velocity
        rate = odometry.angular_velocity_body
        return odometry._replace(
            stamp_ns=odometry.stamp_ns + round(horizon * 1e9),
            position=(x + vx * ahead, y + vy * ahead, z + vz * ahead),
            orientation_wxyz=rotate_ahead(odometry.orientation_wxyz, rate, horizon),
            velocity=(vx * left, vy * left, vz * left),
        )


def build(time_constant: float = 2.0) -> Fading:
    """Return the predictor; `time_constant` [s] is a parameter of the experiment."""
    return Fading(time_constant)
