# SPDX-License-Identifier: Apache-2.0

"""Predictor: use the last odometry without a prediction.

Source: docs/reference/control.md, "Predictors", (a): the baseline for the other predictors.
"""

from __future__ import annotations

from cloudrc.cloud.predictors import Predictor
from cloudrc.wire.messages import Odometry


class LastSample(Predictor):
    """Predicts that the robot does not move: pose and twist stay as measured."""

    def predict(self, odometry: Odometry, horizon: float) -> Odometry:
        """Return `odometry` with a stamp that is later by `horizon` [s]."""
        return odometry._replace(stamp_ns=odometry.stamp_ns + round(horizon * 1e9))


build = LastSample
