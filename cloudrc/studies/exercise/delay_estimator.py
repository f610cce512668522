# SPDX-License-Identifier: Apache-2.0

"""Delay estimator, part 1 of the exercise: the mean of all loop delays so far.

With each new delay tau_n, after k delays:    tau = tau + (tau_n - tau) / (k + 1)

Source: the paper, eq. (1).
"""

from cloudrc.plugin import DelaySample, Estimator


class DelayEstimator(Estimator):
    """Mean of the loop delays since the session began."""

    def update(self, sample: DelaySample) -> None:
        """Add a loop delay to the mean: `sample.loop_delay` [s], the tau_n of eq. (1)."""
        # Your code: eq. (1).

    def horizon(self, age: float) -> float:
        """Return the horizon tau [s], 0 before the first delay; this estimator ignores `age`."""
        return 0.0  # Your code.


def build() -> DelayEstimator:
    """Make an estimator; every session gets a new one."""
    return DelayEstimator()
