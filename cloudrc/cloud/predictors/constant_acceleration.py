# SPDX-License-Identifier: Apache-2.0

"""Predictor: extrapolate with the measured velocity and the recent acceleration.

Source: the paper, eq. (3), with the acceleration computed from recent velocities;
docs/reference/control.md, "Predictors", (d).
"""

from __future__ import annotations

from collections import deque

from cloudrc.cloud.predictors import Predictor, moved
from cloudrc.config.schema import Positive
from cloudrc.wire.messages import ZERO, Odometry, Vector


class ConstantAcceleration(Predictor):
    """Predicts with the measured velocity and the mean acceleration in a short time window.

    Args:
        window: Longest time between the two samples that give the acceleration [s]; at least one
            period of the odometry. A longer window reduces the noise, but the acceleration lags by
            half the window.
    """

    def __init__(self, window: Positive = 0.05) -> None:
        self._window_ns = round(window * 1e9)
        self._recent: deque[Odometry] = deque()
        self._acceleration = ZERO

    def observe(self, odometry: Odometry) -> None:
        """Compute the acceleration from the oldest sample in the window to this sample.

        A sample whose stamp is not later than the last stamp is ignored. After a gap longer than
        the window, the acceleration is zero until the next sample.
        """
        recent, stamp_ns = self._recent, odometry.stamp_ns
        if recent and stamp_ns <= recent[-1].stamp_ns:
            return
        recent.append(odometry)
        while stamp_ns - recent[0].stamp_ns > self._window_ns:
            recent.popleft()
        oldest = recent[0]
        self._acceleration = _mean_acceleration(oldest, odometry) if len(recent) > 1 else ZERO

    def reset(self) -> None:
        """Forget all samples; the acceleration is zero until there are two new samples."""
        self._recent.clear()
        self._acceleration = ZERO

    def predict(self, odometry: Odometry, horizon: float) -> Odometry:
        """Extrapolate a sample by `horizon`, tau [s]: p + v · tau + a · tau^2 / 2, and v + a · tau.

        Source: the paper, eq. (3b), for the velocity.
        Deviation: eq. (3a) as printed has no acceleration in the position.
        """
        px, py, pz = odometry.position
        vx, vy, vz = odometry.velocity
        ax, ay, az = self._acceleration
        # From here on, a is the change of the velocity over the horizon [m/s].
        ax, ay, az = ax * horizon, ay * horizon, az * horizon
        position = (
            px + (vx + 0.5 * ax) * horizon,
            py + (vy + 0.5 * ay) * horizon,
            pz + (vz + 0.5 * az) * horizon,
        )
        return moved(odometry, horizon, position, (vx + ax, vy + ay, vz + az))


def _mean_acceleration(start: Odometry, end: Odometry) -> Vector:
    per_second = 1e9 / (end.stamp_ns - start.stamp_ns)
    ax, ay, az = start.velocity
    bx, by, bz = end.velocity
    return ((bx - ax) * per_second, (by - ay) * per_second, (bz - az) * per_second)


build = ConstantAcceleration
