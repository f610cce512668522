# SPDX-License-Identifier: Apache-2.0

"""Predictor: extrapolate the position with the last commanded velocity.

Source: the authors' published code, which multiplies the delay by the last commanded velocity. The
paper, eq. (3), multiplies the delay by the measured velocity.
"""

from __future__ import annotations

from cloudrc.cloud.predictors import Predictor, moved
from cloudrc.wire.messages import ZERO, Command, Odometry


class CommandedVelocity(Predictor):
    """Adds the last commanded velocity times the horizon to the position.

    At the position p, with the horizon tau and a proportional controller, the command is
    u = -K · (p + u · tau). This gives u = -K · p / (1 + K · tau): a longer delay lowers the
    effective gain. This damps the motion, but the predictions are bad.
    """

    def __init__(self) -> None:
        self._commanded = ZERO

    def commanded(self, command: Command) -> None:
        """Remember the velocity of the newest command [m/s]."""
        self._commanded = command.velocity

    def reset(self) -> None:
        """Forget the last command; the commanded velocity is zero until the next command."""
        self._commanded = ZERO

    def predict(self, odometry: Odometry, horizon: float) -> Odometry:
        """Extrapolate a sample by `horizon`, tau [s]: p + u · tau, with the commanded velocity u.

        The velocity stays as measured. The orientation is extrapolated as in all predictors.
        Source: the authors' published code.
        """
        px, py, pz = odometry.position
        ux, uy, uz = self._commanded
        position = (px + ux * horizon, py + uy * horizon, pz + uz * horizon)
        return moved(odometry, horizon, position, odometry.velocity)


build = CommandedVelocity
