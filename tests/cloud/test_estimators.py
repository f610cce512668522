# SPDX-License-Identifier: Apache-2.0

"""Delay estimators by hand-worked numbers, in seconds."""

import pytest

from cloudrc.cloud.estimators import (
    DelaySample,
    earliest,
    ewma,
    running_mean,
    running_mean_500,
    split,
)


def horizons(estimator, *delays):
    """Return the horizon after each loop delay."""
    found = []
    for seconds in delays:
        # Another delay would give another result if it were used.
        estimator.update(DelaySample(seconds, seconds - 0.006))
        found.append(estimator.horizon(0.0))
    return found


@pytest.mark.parametrize(
    ("estimator", "delays", "expected"),
    [
        # Eq. (1): 40 / 1; + (60 - 40) / 2; + (80 - 50) / 3; + (20 - 60) / 4
        (running_mean.build(), (0.040, 0.060, 0.080, 0.020), (0.040, 0.050, 0.060, 0.050)),
        (running_mean_500.build(count_max=2), (0.040, 0.060, 0.080), (0.040, 0.050, 0.065)),
        (ewma.build(), (0.040, 0.060), (0.040, 0.041)),
    ],
)
def test_first_horizons(estimator, delays, expected):
    assert horizons(estimator, *delays) == pytest.approx(expected)


OFFSET = -86_400.0
"""World's clock minus cloud's clock [s]."""


def test_earliest_adds_the_age_and_the_smallest_delay():
    estimator, found = earliest.build(count=2), []
    for delay in (0.060, 0.030, 0.095, 0.095):
        estimator.add_applied(delay - OFFSET)
        found.append(estimator.horizon(0.010 + OFFSET))
    assert found == pytest.approx([0.070, 0.040, 0.040, 0.105])


def test_split_adds_the_age_and_cancels_the_clock_offset():
    estimator = split.build(gain=0.25)
    estimator.add_applied(0.050 - OFFSET)
    # The age of a slow packet counts at once, the downlink by its average.
    found = [estimator.horizon(age + OFFSET) for age in (0.030, 0.090)]
    estimator.add_applied(0.090 - OFFSET)
    found.append(estimator.horizon(0.030 + OFFSET))
    assert found == pytest.approx([0.080, 0.140, 0.090], abs=1e-9)
    assert estimator.horizon(-5.0 + OFFSET) == 0.0, "never negative when world's clock jumps"
