"""A number that probes measure: how it scatters on a true link, and when it is believed.

It is believed if a confidence interval around what was measured lies within its margin of what was
asked (a test of equivalence): one that is off by the margin passes with chance MISS.

Source: D. J. Schuirmann, "A comparison of the two one-sided tests procedure and the power
approach", J. Pharmacokin. Biopharm. 15, 1987.
"""

from __future__ import annotations

from dataclasses import dataclass
from math import ceil, sqrt
from statistics import NormalDist

MISS = 1e-3
"""Chance that a quantity which is off by its margin is believed."""
ALARM = 2.5e-7
"""Chance that a true one is not, to each side: two directions with up to 8 quantities, each with
two sides, add up to 0.8e-5."""

Z_MISS = NormalDist().inv_cdf(1.0 - MISS)
"""Of a normal deviate."""
_Z_ALARM = NormalDist().inv_cdf(1.0 - ALARM)
_WIDER = 1.1
"""A link that is off by its margin scatters a little more than a true one."""


@dataclass(frozen=True, slots=True)
class Quantity:
    """What is expected of one measured number.

    Attributes:
        expected: On a true link [s] or [1].
        spread: Standard deviation of what n probes measure, times the root of n [s] or [1].
        skew: Skewness of what `batch` probes measure [1].
        batch: That number of probes.
        margin: How far off it may be [s] or [1].
        blur: What others than the link may add to it, to either side [s] or [1].
    """

    expected: float
    spread: float
    skew: float
    batch: int
    margin: float
    blur: float = 0.0

    def noise(self, count: int) -> float:
        """Say how far off a true link's value may seem to be with `count` probes."""
        skew = abs(self.skew) * (self.batch / count) ** 0.5
        return self.blur + self.spread / sqrt(count) * _quantile(skew)

    def slack(self, count: int) -> float:
        """Say by how much what `count` probes measure may deviate; negative: it proves nothing."""
        return self.margin - Z_MISS * _WIDER * self.spread / sqrt(count)

    def needs(self) -> int:
        """Count the probes after which a true link passes."""
        room = self.margin - self.blur
        if room <= 0.0:
            return 1 << 40
        count = ceil(((_Z_ALARM + _WIDER * Z_MISS) * self.spread / room) ** 2)
        count = max(64, count)
        while self.slack(count) < self.noise(count):
            count = ceil(count * 1.1)
        return count


def _quantile(skew: float) -> float:
    """Quantile at ALARM of what is nearly normal but has some skewness, >= 0 [1].

    Source: Pearson's type III by the approximation of E. B. Wilson and M. M. Hilferty, "The
    distribution of chi-square", PNAS 17, 1931.
    """
    if skew < 1e-3:
        return _Z_ALARM
    cube = max(0.0, 1.0 + skew * _Z_ALARM / 6.0 - skew**2 / 36.0) ** 3
    return 2.0 / skew * (cube - 1.0)
