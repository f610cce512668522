# SPDX-License-Identifier: Apache-2.0

"""Intervals and tests have the values of published tables."""

from itertools import compress, product

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from cloudrc.base import statistics
from cloudrc.base.statistics import (
    exact_interval,
    holm,
    median_interval,
    paired,
    sign_test,
    signed_rank_test,
)

MAIZE = [6, 8, 14, 16, 23, 24, 28, 29, 41, -48, 49, 56, 60, -67, 75]
"""C. Darwin's pairs of maize plants, 1876; the example of scipy.stats.wilcoxon."""


@given(st.permutations(range(1, 21)))
@settings(max_examples=20, deadline=None)
def test_the_interval_of_the_median_has_the_bounds_of_textbooks(values):
    """Its probability is 0.9586 with 20 values; the range of 5 values has only 0.9375."""
    assert median_interval(values) == (6, 15)
    assert median_interval(values[:5]) is None
    assert median_interval(values[:6]) == (min(values[:6]), max(values[:6]))


@pytest.mark.parametrize(
    ("successes", "count", "low", "high"),
    [(0, 10, 0, 0.3085), (5, 10, 0.1871, 0.8129), (10, 10, 0.6915, 1), (81, 263, 0.2527, 0.3676)],
)
def test_the_exact_interval_has_published_values(successes, count, low, high):
    """R. G. Newcombe, 1998, table I, method 5 has 81 of 263."""
    assert exact_interval(successes, count) == pytest.approx((low, high), abs=5e-5)


@pytest.mark.parametrize(
    ("less", "more", "p"), [(0, 0, 1), (0, 10, 2 / 1024), (1, 9, 22 / 1024), (5, 5, 1)]
)
def test_the_sign_test_counts_the_binomial_tail(less, more, p):
    assert sign_test(less, more) == sign_test(more, less) == pytest.approx(p)


def test_the_signed_rank_test_has_a_published_value():
    assert signed_rank_test(MAIZE) == pytest.approx(0.041259765625)


@given(st.lists(st.integers(-5, 5), max_size=10))
@settings(max_examples=60, deadline=None)
def test_the_signed_rank_test_counts_all_choices_of_signs(values):
    """Zeros are left out, and ties share their ranks."""
    sizes = [abs(value) for value in values if value]
    ranks = [sum(other < size for other in sizes) + (sizes.count(size) + 1) / 2 for size in sizes]
    negative = sum(compress(ranks, (value < 0 for value in values if value)))
    smaller = min(negative, sum(ranks) - negative)
    sums = [sum(compress(ranks, signs)) for signs in product((0, 1), repeat=len(ranks))]
    p = 2 * sum(each <= smaller for each in sums) / len(sums)
    assert signed_rank_test(values) == pytest.approx(min(1.0, p))


def test_the_normal_approximation_continues_the_exact_test(monkeypatch):
    rng = np.random.default_rng(1)
    values = rng.normal(0.15, 1.0, 150).tolist()
    exact, interval = signed_rank_test(values), paired(values).interval
    monkeypatch.setattr(statistics, "EXACT_MAX", 0)
    assert signed_rank_test(values) == pytest.approx(exact, rel=0.03)
    assert paired(values).interval == pytest.approx(interval, abs=0.005)


def test_the_interval_of_the_difference_has_published_values():
    """M. Hollander, D. A. Wolfe, 1999, example 3.4: Hamilton's scale before and after a drug."""
    before = [1.83, 0.50, 1.62, 2.48, 1.68, 1.88, 1.55, 3.06, 1.30]
    after = [0.878, 0.647, 0.598, 2.05, 1.06, 1.29, 1.06, 3.14, 1.29]
    found = paired([b - a for a, b in zip(before, after, strict=True)])
    assert found.difference == pytest.approx(-0.46, abs=5e-4)
    assert found.interval == pytest.approx((-0.786, -0.010), abs=5e-4)
    assert found.p_wilcoxon == pytest.approx(0.0390625)
    assert (found.lower, found.higher, found.decided) == (7, 2, True)


@given(st.lists(st.floats(-9, 9).filter(lambda x: abs(x) > 1e-3), min_size=6, max_size=14,
                unique_by=abs))  # fmt: skip
@settings(max_examples=100, deadline=None)
def test_interval_and_p_agree_without_ties(values):
    found = paired(values)
    assert (found.interval[0] * found.interval[1] > 0) == (found.p_wilcoxon < 0.05)
    mirrored = paired([-value for value in values])
    assert mirrored.difference == pytest.approx(-found.difference)
    assert mirrored.pairs_needed == found.pairs_needed


def test_the_number_of_pairs_needed_has_power_80_percent():
    """For a shift of half a standard deviation, the formula gives 39 pairs."""
    rng = np.random.default_rng(3)
    needed = paired(rng.normal(0.5, 1.0, 2000).tolist()).pairs_needed
    assert needed == pytest.approx(39, abs=4)
    samples = rng.normal(0.5, 1.0, (500, needed))
    power = np.mean([signed_rank_test(sample.tolist()) < 0.05 for sample in samples])
    assert 0.77 <= power <= 0.88


def test_differences_that_are_equal_up_to_rounding_share_their_ranks_and_cancel():
    rounded = [0.1 + 0.2, -0.3, 0.3, 0.7, -0.7, 0.1 + 0.6]
    exact = [0.3, -0.3, 0.3, 0.7, -0.7, 0.7]
    assert signed_rank_test(rounded) == signed_rank_test(exact)
    found = paired([0.1 + 0.2, -0.3] * 4)
    assert (found.difference, found.decided, found.pairs_needed) == (0.0, False, None)


def test_holms_p_has_the_values_of_a_calculation_by_hand():
    """4 · .005, then 3 · .01, then 2 · .03, then the p before it, which is above .04."""
    assert holm([0.01, 0.04, 0.03, 0.005]) == pytest.approx([0.03, 0.06, 0.06, 0.02])
    assert holm([0.5, 0.6]) == [1.0, 1.0]
    assert holm([]) == []
