# SPDX-License-Identifier: Apache-2.0

"""Estimator: the loop delay, smoothed as TCP smooths its round-trip times.

All times are in s.
Source: RFC 6298, section 2.3: SRTT = (1 - alpha) SRTT + alpha R, alpha = 1/8.
"""

from cloudrc.plugin import DelaySample, Estimator


class Smoothed(Estimator):
    """Follows the loop delay; a sample has the weight `alpha` [1]."""

    def __init__(self, alpha: float) -> None:
        self.alpha = alpha
        self.delay = 0.0
        self.is_first = True

    def update(self, sample: DelaySample) -> None:
        """Take the delays that one telemetry datagram shows; `sample.rtt` is without the hold."""
        weight = 1.0 if self.is_first else self.alpha
        self.delay += weight * (sample.loop_delay - self.delay)
        self.is_first = False

    def horizon(self, age: float) -> float:
        """Return how far ahead to predict [s]; 0 before the first sample. It needs no `age` [s]."""
        return self.delay


def build(alpha: float = 0.125) -> Smoothed:
    """Return the estimator; `alpha` [1] is a parameter of the experiment."""
    return Smoothed(alpha)
