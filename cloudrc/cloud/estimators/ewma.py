# SPDX-License-Identifier: Apache-2.0

"""Delay estimator: the exponentially weighted moving average of the loop delay.

With a gain of 0.05, the RMS error at a step of the delay is a third of that of eq. (1) of the
paper. At a constant delay, both errors are equal.
Source: docs/reference/control.md, "Delay estimators".
"""

from __future__ import annotations

from cloudrc.cloud.estimators import DelaySample, Estimator
from cloudrc.config.schema import Gain


class Ewma(Estimator):
    """Exponentially weighted moving average of the loop delay; it starts at the first sample.

    Args:
        gain: Weight of a new sample [1]; 0.05 forgets within about 20 samples, 0.2 s at 100 Hz.
    """

    def __init__(self, gain: Gain = 0.05) -> None:
        self._gain = gain
        self._average: float | None = None

    def update(self, sample: DelaySample) -> None:
        """Add one loop delay [s]: average += gain · (sample - average)."""
        if self._average is None:
            self._average = sample.loop_delay
        else:
            self._average += self._gain * (sample.loop_delay - self._average)

    def horizon(self, age: float) -> float:
        """Return the average loop delay [s]; 0 before the first sample. `age` has no effect."""
        return 0.0 if self._average is None else max(0.0, self._average)


build = Ewma
