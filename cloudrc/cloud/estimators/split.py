# SPDX-License-Identifier: Apache-2.0

"""Delay estimator: the age of the newest odometry plus the average delay of the downlink.

Source: docs/reference/control.md, "Delay estimators": the best of the compared estimators, because
it measures the uplink delay of each packet and estimates only the downlink delay.

The clocks need no synchronisation. With `offset` = cloud's clock minus world's clock,

    now - stamp of the odometry          = age of the odometry + offset   (exact, this packet)
    application - stamp of the command   = downlink delay - offset        (averaged)

and the sum is the time from the measurement to the application of the command.
"""

from __future__ import annotations

from cloudrc.cloud.estimators import Estimator
from cloudrc.config.schema import Gain


class Split(Estimator):
    """Estimates the delay: age of the newest odometry plus the average of `applied_minus_stamp`.

    `applied_minus_stamp` is the downlink delay of a command minus the clock offset cloud - world.

    Args:
        gain: Weight of a new sample in the average of the downlink delay [1].
    """

    def __init__(self, gain: Gain = 0.05) -> None:
        self._gain = gain
        self._applied_minus_stamp: float | None = None

    def add_applied(self, applied_minus_stamp: float) -> None:
        """Average `applied_minus_stamp` [s]: the downlink delay minus the clock offset."""
        if self._applied_minus_stamp is None:
            self._applied_minus_stamp = applied_minus_stamp
        else:
            self._applied_minus_stamp += self._gain * (
                applied_minus_stamp - self._applied_minus_stamp
            )

    def horizon(self, age: float) -> float:
        """Return the horizon [s]: `age` plus the average downlink delay; 0 before the first echo.

        `age` and the average contain the clock offset with opposite signs; the sum is free of it.
        """
        if self._applied_minus_stamp is None:
            return 0.0
        return max(0.0, age + self._applied_minus_stamp)


build = Split
