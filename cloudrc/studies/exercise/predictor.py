# SPDX-License-Identifier: Apache-2.0

"""Part 2 of the exercise: predict the state of the robot when the next command acts, tau later.

    position = p + v tau      velocity = v + a tau, with a = 0, because a is not measured
    orientation: "similarly", with the angular velocity; use `rotate_ahead`

Source: the paper, eqs. (2) and (3).
"""

from cloudrc.plugin import Odometry, Predictor, rotate_ahead  # noqa: F401


class StudentPredictor(Predictor):
    """Predicts with constant velocity and constant angular velocity."""

    def predict(self, odometry: Odometry, horizon: float) -> Odometry:
        """Predict the odometry for `horizon` [s] later; `horizon` is tau in the equations.

        The stamp `stamp_ns` [ns], an integer, of the result is later by the same time.

        `odometry._replace(position=(x, y, z))` returns a copy with another position.
        """
        return odometry  # Your code: eqs. (2) and (3).


def build() -> StudentPredictor:
    """Make a predictor."""
    return StudentPredictor()
