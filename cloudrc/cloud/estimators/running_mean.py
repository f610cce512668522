# SPDX-License-Identifier: Apache-2.0

"""Delay estimator: the mean of all loop delays so far.

Source: the paper, eq. (1).
"""

from __future__ import annotations

from math import inf

from cloudrc.cloud.estimators import DelaySample, Estimator


class RunningMean(Estimator):
    """Mean of the loop delays since the session began.

    All delays have the same weight: if the delay jumps 60 s after the session began, the mean needs
    another 60 s to cover half of the jump. A finite `count_max` makes the mean follow faster.
    """

    def __init__(self, count_max: float = inf) -> None:
        """Set the number of samples after which the weight of a new sample stays constant.

        This weight is 1/`count_max` [1]. By default all samples have the same weight in the mean.
        """
        self._count_max, self._count, self._mean = count_max, 0, 0.0

    def update(self, sample: DelaySample) -> None:
        """Add one loop delay [s] after k samples: mean += (sample - mean) / (k + 1).

        Source: the paper, eq. (1), as printed; tau_n is `loop_delay`, which includes the hold time.
        """
        if self._count < self._count_max:
            self._count += 1
        self._mean += (sample.loop_delay - self._mean) / self._count

    def horizon(self, age: float) -> float:
        """Return the mean [s]. `age` has no effect."""
        return self._mean if self._mean > 0.0 else 0.0


def build() -> RunningMean:
    """Make the estimator of the paper's eq. (1), which has no parameters."""
    return RunningMean()
