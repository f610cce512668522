"""Delay estimator: the loop delays so far come in, their mean goes out.

Source: the paper, eq. (1).
"""

from __future__ import annotations

from cloudrc.cloud.estimators import DelaySample, Estimator


class RunningMean(Estimator):
    """Mean of all loop delays since the session began.

    Slow by design: after 60 s a step of the delay takes another 60 s to be half tracked.
    """

    def __init__(self) -> None:
        self._count = 0
        self._mean = 0.0

    def update(self, sample: DelaySample) -> None:
        """Add one loop delay [s]: mean += (sample - mean) / (k + 1), k samples before it.

        Source: the paper, eq. (1), as printed; tau_n is `loop_delay`, with the hold on the robot.
        """
        self._count += 1
        self._mean += (sample.loop_delay - self._mean) / self._count

    def horizon(self, age: float) -> float:
        """Return the mean [s]; the age of this very odometry (in [s]) plays no part."""
        return max(0.0, self._mean)


def build() -> RunningMean:
    """Make the estimator of eq. (1); it has no parameters."""
    return RunningMean()
