"""Predictor: odometry comes in and goes out as it is, as if nothing moved on the way.

Source: docs/reference/control.md, "Predictors", (a): the baseline for the others.
"""

from __future__ import annotations

from cloudrc.cloud.predictors import Predictor
from cloudrc.messages import Odometry


class LastSample(Predictor):
    """No prediction: pose and twist are taken to be what they were."""

    def predict(self, odometry: Odometry, horizon: float) -> Odometry:
        """Return the sample for `horizon` [s] later, with only its stamp moved."""
        return Odometry(
            odometry.stamp_ns + round(horizon * 1e9),
            odometry.position,
            odometry.orientation_wxyz,
            odometry.velocity,
            odometry.angular_velocity_body,
        )


def build() -> LastSample:
    """Make the predictor; it has no parameters."""
    return LastSample()
