# SPDX-License-Identifier: Apache-2.0

"""Predictors extrapolate the newest odometry by the horizon, the time until a command acts.

Each predictor is a plug-in in a file of its own. The file defines `build(**parameters)`, which
returns a `Predictor`; all parameters are annotated.

All predictors except `last_sample` extrapolate the orientation by
q(t + tau) = q(t) * exp(omega · tau / 2), where * is the product of quaternions. The formula is
exact while the body's angular velocity is constant. The paper gives no formula ("similarly the
orientation").

Source: J. Sola, "Quaternion kinematics for the error-state Kalman filter", 2017, eqs. (101), (214).
"""

from __future__ import annotations

from math import cos, sin, sqrt

from cloudrc.wire.messages import Command, Odometry, Quaternion, Vector

_new = tuple.__new__  # makes a named tuple twice as fast as its class does


class Model:
    """A simulated robot; the control loop uses it to plan the commands of the near future."""

    def step(self, velocity: Vector, dt: float) -> Odometry:
        """Advance the state by `dt` [s], > 0, under a velocity command [m/s]; return the state."""
        raise NotImplementedError


class Predictor:
    """Extrapolates odometry; a plug-in has to define `predict` only."""

    def observe(self, odometry: Odometry) -> None:
        """Process a new odometry sample; called once per sample, with rising stamps."""

    def commanded(self, command: Command) -> None:
        """Process a command that cloud has just sent."""

    def applied(self, command_stamp_ns: int, applied_ns: int) -> None:
        """Store when world applied a command; called once per command whose echo arrives.

        Args:
            command_stamp_ns: Stamp of the command [ns], cloud's clock. A command may be older than
                that of the last call, because telemetry may arrive late.
            applied_ns: Time when world applied the command [ns], world's clock.
        """

    def reset(self) -> None:
        """Reset the predictor at the start of a session."""

    def predict(self, odometry: Odometry, horizon: float) -> Odometry:
        """Extrapolate the newest sample, `odometry`, and its stamp by `horizon` [s], >= 0."""
        raise NotImplementedError

    def model(self) -> Model | None:
        """Return a new model of the robot in the last predicted state; cloud plans ahead with it.

        By default, return None: the predictor has no model, and cloud cannot make plans.
        """
        return None


def moved(odometry: Odometry, horizon: float, position: Vector, velocity: Vector) -> Odometry:
    """Return a sample after `horizon` [s], with its new position [m] and velocity [m/s].

    The orientation follows from a constant angular velocity.
    """
    stamp_ns, _, orientation, _, rate = odometry
    stamp_ns += round(horizon * 1e9)
    orientation = rotate_ahead(orientation, rate, horizon)
    return _new(Odometry, (stamp_ns, position, orientation, velocity, rate))


def rotate_ahead(
    orientation_wxyz: Quaternion, angular_velocity_body: Vector, horizon: float
) -> Quaternion:
    """Rotate an orientation at a constant angular velocity for the time `horizon`.

    Args:
        orientation_wxyz: Unit quaternion, body to world, shape (4,).
        angular_velocity_body: Angular velocity [rad/s], body frame, shape (3,).
        horizon: Duration of the rotation [s].
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
