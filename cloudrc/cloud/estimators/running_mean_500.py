"""Delay estimator: a running mean of the loop delay whose gain stays at 1/500 after 500 samples.

Source: the authors' published code. Its comments describe a window of 500 samples. The code,
however, computes a mean whose gain 1/(k+1) falls to 1/500; from then on the mean is an exponential
average.
"""

from __future__ import annotations

from cloudrc.cloud.estimators import DelaySample, Estimator
from cloudrc.cloud.parameters import positive


class CappedRunningMean(Estimator):
    """Running mean whose gain falls to 1/count_max and then stays constant."""

    def __init__(self, count_max: int) -> None:
        """Set the number of samples after which the gain stays at 1/count_max."""
        self._count_max = count_max
        self._count = 0
        self._mean = 0.0

    def update(self, sample: DelaySample) -> None:
        """Add one loop delay [s]: mean += (sample - mean) / min(k + 1, count_max)."""
        if self._count < self._count_max:
            self._count += 1
        self._mean += (sample.loop_delay - self._mean) / self._count

    def horizon(self, age: float) -> float:
        """Return the mean [s]; `age` [s] is not used."""
        return max(0.0, self._mean)


def build(count_max: int = 500) -> CappedRunningMean:
    """Make the authors' estimator.

    Args:
        count_max: Number of samples after which the gain stays at 1/count_max.

    Raises:
        ValueError: If `count_max` is not a whole number above 0.
    """
    if positive("count_max", count_max) % 1:
        raise ValueError(f"count_max: {count_max!r} must be a whole number")
    return CappedRunningMean(int(count_max))
