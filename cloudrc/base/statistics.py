# SPDX-License-Identifier: Apache-2.0

"""Compute medians, paired differences and success rates, with exact intervals and tests.

No function uses random numbers. docs/method.md explains the choice of the methods.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cache
from statistics import NormalDist
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cloudrc.base import rounding

LEVEL = 0.05
"""Significance level of the tests: an effect is decided if its p-value is below this value [1]."""
POWER = 0.80
"""Probability with which `pairs_needed` pairs decide [1]."""
PAIRS_MIN = 6
"""Smallest number of pairs that can decide: with 5 pairs, p is at least 2 / 2^5, above 0.05."""
EXACT_MAX = 200
"""Largest number of pairs with an exact signed-rank test; above it, the normal approximation."""
Z = NormalDist().inv_cdf(1 - LEVEL / 2)


def median_interval(values: Sequence[float]) -> tuple[float, float] | None:
    """Return the 95 % confidence interval of the median of `values`, for any distribution.

    The k-th smallest and the k-th largest of n values enclose the median with probability
    1 - 2 · sum_{i<k} C(n, i) / 2^n. The interval uses the largest k with a probability of at least
    95 %. The function returns None for fewer than 6 values, because no k reaches 95 %.

    Source: H. A. David, H. N. Nagaraja, Order Statistics, 3rd ed., 2003, section 7.1.
    """
    ordered, k = sorted(values), _outermost(len(values))
    return (ordered[k - 1], ordered[-k]) if k else None


@cache  # the metrics of a sweep have the same number of values
def _outermost(n: int) -> int:
    """Return k: the interval ends at the k-th smallest and largest of `n` values; 0 if none."""
    chances = np.cumsum([ways / 2**n for ways in _choices(n, n // 2)])
    return int(np.searchsorted(chances, LEVEL / 2, side="right"))


def exact_interval(successes: int, count: int) -> tuple[float, float]:
    """Return the 95 % confidence interval of a success rate, in [0, 1]; `count` is at least 1.

    The lower bound is the rate with which `successes` or more of `count` flights succeed with a
    probability of 2.5 %; the upper bound is that for `successes` or fewer. The interval contains
    the true rate with a probability of at least 95 % for every rate and count.

    Source: C. J. Clopper, E. S. Pearson, "The use of confidence or fiducial limits illustrated in
    the case of the binomial", 1934.
    """
    low = _rate(successes - 1, count, 1.0 - LEVEL / 2) if successes else 0.0
    high = _rate(successes, count, LEVEL / 2) if successes < count else 1.0
    return low, high


def _rate(most: int, count: int, chance: float) -> float:
    """Return the rate with which at most `most` of `count` flights succeed with this chance [1]."""
    numbers = range(most + 1)
    whole = math.lgamma(count + 1)
    ways = [whole - math.lgamma(k + 1) - math.lgamma(count - k + 1) for k in numbers]
    done, failed = np.array(numbers), count - np.array(numbers)
    low, high = 0.0, 1.0
    while high - low > 1e-12:
        middle = (low + high) / 2
        logarithms = ways + done * math.log(middle) + failed * math.log1p(-middle)
        low, high = (middle, high) if np.exp(logarithms).sum() > chance else (low, middle)
    return (low + high) / 2


def sign_test(less: int, more: int) -> float:
    """Return the exact two-sided p-value for "two kinds of events are equally likely".

    `less` and `more` are the numbers of events of each kind. In the sign test, `less` counts
    the pairs with B below A, `more` the pairs with B above A. In the exact McNemar test, `less`
    counts the pairs in which only A succeeded, `more` the pairs in which only B succeeded.

    Source: Q. McNemar, "Note on the sampling error of the difference between correlated
    proportions or percentages", 1947.
    """
    return min(1.0, 2 * tail(min(less, more), less + more))


def tail(few: int, n: int, chance: float = 0.5) -> float:
    """Return the probability of at most `few` of `n` events, each with probability `chance` [1]."""
    part, whole = chance.as_integer_ratio()  # the sum is exact
    ways = enumerate(_choices(n, few + 1))
    found = sum(each * part**k * (whole - part) ** (n - k) for k, each in ways)
    return float(found / whole**n)


def holm(ps: Sequence[float]) -> list[float]:
    """Return the adjusted p of each of the p-values `ps`, in their order.

    If all null hypotheses are true, or some of them, an adjusted p of a true one is below 5 % with
    a probability of at most 5 %, however the tests depend on each other.

    Source: S. Holm, "A simple sequentially rejective multiple test procedure", 1979.
    """
    adjusted, largest = [1.0] * len(ps), 0.0
    for rank, place in enumerate(sorted(range(len(ps)), key=ps.__getitem__)):
        largest = max(largest, min(1.0, (len(ps) - rank) * ps[place]))
        adjusted[place] = largest
    return adjusted


def by_chance(count: int) -> str:
    """Say how many of several tests and intervals are wrong by chance."""
    return (
        f"{count} tests and intervals at 95 %: about {LEVEL * count:.2g} of them are wrong by "
        "chance alone; Holm's p, over all tests, allows for this"
    )


def _choices(n: int, count: int) -> Iterator[int]:
    """Yield in how many ways 0, 1, ..., `count` - 1 of `n` can be chosen."""
    ways = 1
    for chosen in range(count):
        yield ways
        ways = ways * (n - chosen) // (chosen + 1)


def signed_rank_test(differences: Sequence[float]) -> float:
    """Return the two-sided p-value of Wilcoxon's signed-rank test of paired differences, any unit.

    Zeros are left out. Differences of equal size get the mean of their ranks, and p is exact for
    these ranks. With more than 200 pairs, p is the normal approximation with continuity correction.

    Source: F. Wilcoxon, "Individual comparisons by ranking methods", 1945.
    """
    values = np.array([value for value in differences if value], dtype=float)
    if not len(values):
        return 1.0
    doubled = _doubled_ranks(np.abs(values))
    total = int(doubled[values > 0].sum())
    smaller = min(total, int(doubled.sum()) - total)
    if len(doubled) > EXACT_MAX:
        spread = math.sqrt(float((doubled.astype(float) ** 2).sum()) / 4)
        p = NormalDist().cdf((smaller + 1 - doubled.sum() / 2) / spread)
    else:
        p = float(_sums(doubled)[: smaller + 1].sum())
    return min(1.0, 2 * p)


def _doubled_ranks(sizes: NDArray[Any]) -> NDArray[Any]:
    """Return twice the rank of each size, a whole number; equal sizes share their ranks."""
    order = np.argsort(sizes)
    ordered = sizes[order]
    group = np.cumsum(rounding.differences(ordered[:-1], ordered[1:]) > 0.0, dtype=np.int64)
    kinds = np.concatenate(([0], group))
    counts = np.bincount(kinds)
    doubled = np.empty(len(sizes), dtype=np.int64)
    doubled[order] = (2 * np.cumsum(counts) - counts + 1)[kinds]
    return doubled


def _sums(ranks: NDArray[Any]) -> NDArray[Any]:
    """Return the distribution of S, the sum of the positive ranks.

    Element k is the probability that S = k, if each of `ranks`, whole numbers of shape (n,), is
    positive or negative with probability 1/2.
    """
    chances = np.zeros(int(ranks.sum()) + 1)
    chances[0] = 1.0
    for rank in ranks:
        chances /= 2
        chances[rank:] += chances[:-rank].copy()
    return chances


@dataclass(frozen=True, slots=True)
class Paired:
    """Evaluation of paired differences B - A of one metric; [u] is the unit of the metric."""

    count: int
    lower: int  # pairs in which B is below A
    higher: int  # pairs in which B is above A
    difference: float  # Hodges-Lehmann estimate: median of the means of two differences [u]
    interval: tuple[float, float] | None  # 95 % interval of the difference; None below 6 pairs
    p_wilcoxon: float  # signed-rank test [1]
    p_sign: float  # sign test [1]
    decided: bool  # whether p_wilcoxon is below 5 % and the interval excludes 0
    pairs_needed: int | None  # pairs that decide with a power of 80 %; None without an effect


def paired(differences: Sequence[float]) -> Paired:
    """Evaluate at least one paired difference B - A, any unit.

    The interval contains each shift that the signed-rank test does not reject after the shift is
    subtracted from the differences. It assumes differences that are symmetric around their centre.

    Source: J. L. Hodges, E. L. Lehmann, "Estimates of location based on rank tests", 1963;
    M. Hollander, D. A. Wolfe, E. Chicken, Nonparametric Statistical Methods, 3rd ed., 2013,
    section 3.3.
    """
    values = np.sort(np.asarray(differences, dtype=float))
    n, lower, higher = len(values), int((values < 0).sum()), int((values > 0).sum())
    means, cut = _means(values), _cut(n)
    interval = (float(means[cut]), float(means[-1 - cut])) if cut >= 0 else None
    p = signed_rank_test(values.tolist())
    decided = interval is not None and p < LEVEL and (interval[0] > 0 or interval[1] < 0)
    needed = _pairs_needed(values, means, PAIRS_MIN if decided else max(PAIRS_MIN, n + 1))
    middle, p_sign = float(np.median(means)), sign_test(lower, higher)
    return Paired(n, lower, higher, middle, interval, p, p_sign, decided, needed)


def _means(values: NDArray[Any]) -> NDArray[Any]:
    """Return the means of every two of the sorted `values`, and each value itself, in order."""
    n = len(values)
    return np.sort(
        np.concatenate([rounding.differences(-values[i], values[i:]) / 2 for i in range(n)])
    )


def _cut(n: int) -> int:
    """Return the critical value of the signed-rank test for `n` pairs.

    The test finds a difference if the sum of the positive ranks, or that of the negative ranks, is
    at most this value. It is -1 if `n` is too small to find any difference.
    """
    if n > EXACT_MAX:
        mean, spread = n * (n + 1) / 4, math.sqrt(n * (n + 1) * (2 * n + 1) / 24)
        return math.floor(mean - 0.5 - Z * spread)
    chances = np.cumsum(_sums(np.arange(1, n + 1)))
    return int(np.searchsorted(chances, LEVEL / 2, side="right")) - 1


def _pairs_needed(values: NDArray[Any], means: NDArray[Any], least: int) -> int | None:
    """Return how many pairs the signed-rank test needs for a power of 80 %: `least` or more.

    Return None if the data show no effect. `values` contains the n differences B - A.
    Source: G. E. Noether, "Sample size determination for some common nonparametric tests", 1987.
    """
    n = len(values)
    # The share of means of two different pairs that are above 0; a mean of 0 counts half.
    above = np.sign(means).sum() - np.sign(values).sum()
    effect = abs(above) / max(n * (n - 1), 1)  # = |share - 1/2|
    if effect == 0:
        return None
    z = Z + NormalDist().inv_cdf(POWER)
    return max(least, math.ceil(float(z * z / (3 * effect * effect))))
