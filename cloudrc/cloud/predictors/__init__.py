"""Predictors: odometry that is old by `horizon` becomes a prediction; one file each.

A plug-in file has a `build(**parameters)` with annotated parameters that returns a `Predictor`.

Rotation ahead in time, shared by the predictors: orientation and body rate in, orientation out.

q(t + tau) = q(t) * exp(omega tau / 2), exact while the body's angular velocity is constant. The
paper says only "similarly the orientation".

Source: J. Sola, "Quaternion kinematics for the error-state Kalman filter", 2017, eqs. (101), (214).
"""

from __future__ import annotations

from math import cos, sin, sqrt

from cloudrc.messages import Command, Odometry, Quaternion, Vector


class Predictor:
    """Moves odometry ahead in time. Only `predict` has to be written."""

    def observe(self, odometry: Odometry) -> None:
        """Take note of a newly arrived odometry sample (called once each, stamps rising)."""

    def commanded(self, command: Command) -> None:
        """Take note of a command that has just been sent."""

    def reset(self) -> None:
        """Forget everything: a new session begins."""

    def predict(self, odometry: Odometry, horizon: float) -> Odometry:
        """Move `odometry` ahead.

        Args:
            odometry: Newest sample delivered. Position [m], velocity [m/s], world frame.
            horizon: Time to look ahead [s], >= 0.

        Returns:
            A new sample; `stamp_ns` advanced by `horizon`.
        """
        raise NotImplementedError


def rotate_ahead(
    orientation_wxyz: Quaternion, angular_velocity_body: Vector, horizon: float
) -> Quaternion:
    """Turn an orientation by a constant body rate.

    Args:
        orientation_wxyz: Unit quaternion, body to world, shape (4,).
        angular_velocity_body: [rad/s], body frame, shape (3,).
        horizon: How long it turns [s].

    Returns:
        Unit quaternion, body to world, shape (4,).
    """
    x, y, z = angular_velocity_body
    rate = sqrt(x * x + y * y + z * z)
    if rate == 0.0:
        return orientation_wxyz
    half_angle = 0.5 * rate * horizon
    scale = sin(half_angle) / rate
    w, x, y, z = cos(half_angle), scale * x, scale * y, scale * z
    a, b, c, d = orientation_wxyz
    return (
        a * w - b * x - c * y - d * z,
        a * x + b * w + c * z - d * y,
        a * y - b * z + c * w + d * x,
        a * z + b * y - c * x + d * w,
    )
