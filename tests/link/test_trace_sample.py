"""The statistics of a stream agree with its profile."""

from __future__ import annotations

from dataclasses import replace
from math import isnan, sqrt

import numpy as np
import pytest

from cloudrc.link.model import Numbers, Stream, loss_runs, numbers, sample
from cloudrc.link.profile import DirectionProfile, GilbertElliott
from tests.link.conftest import MS, TELEMETRY, link


def measured(profile: DirectionProfile, count: int = 20_000) -> Numbers:
    return numbers(sample(link(profile), TELEMETRY, range(0, count * 10 * MS, 10 * MS), 191))


def test_uniform_jitter_larger_than_the_gap_reorders() -> None:
    """Two packets 10 ms apart with 45±25 ms each are reordered in 0.32 of the cases.

    The difference of two uniform delays is triangular on (-50, 50) ms: above 10 ms with chance
    (1 - 10/50)^2 / 2 = 0.32; with the ones after it the share is larger.
    """
    found = measured(DirectionProfile(0.045, 0.025))
    assert found.mean == pytest.approx(0.045, abs=0.0005)
    assert found.deviation == pytest.approx(0.025 / sqrt(3), rel=0.02)
    assert (found.least, found.most) == pytest.approx((0.020, 0.070), abs=0.0001)
    assert 0.32 < found.overtaken < 0.7
    assert abs(found.correlation) < 0.03


def test_in_order_nothing_is_overtaken_and_the_mean_rises() -> None:
    found = measured(DirectionProfile(0.045, 0.025, keep_order=True))
    assert found.overtaken == 0.0
    assert found.mean > 0.050


@pytest.mark.parametrize(
    ("distribution", "lag_one"), [("normal", 0.50), ("uniform", 0.48), ("pareto", 0.38)]
)
def test_a_correlation_of_a_half_survives_its_distribution(
    distribution: str, lag_one: float
) -> None:
    profile = DirectionProfile(1.0, 0.01, distribution, 0.5)  # type: ignore[arg-type]
    assert measured(profile).correlation == pytest.approx(lag_one, abs=0.03)


@pytest.mark.parametrize(
    ("jitter", "overtaken", "mean", "deviation"),
    [(0.010, 0.12, 0.0704, 0.0054), (0.025, 0.41, 0.0753, 0.0109), (0.040, 0.54, 0.0829, 0.0150)],
)
def test_more_jitter_reorders_more_or_costs_more_delay_in_order(
    jitter: float, overtaken: float, mean: float, deviation: float
) -> None:
    profile = DirectionProfile(0.07, jitter)
    assert measured(profile).overtaken == pytest.approx(overtaken, abs=0.02)
    in_order = measured(replace(profile, keep_order=True))
    assert (in_order.mean, in_order.deviation) == pytest.approx((mean, deviation), abs=0.0005)


def test_losses_in_a_row_are_counted() -> None:
    lost = np.array([0, 1, 1, 0, 1, 0, 0, 1, 1, 1], dtype=bool)
    stream = Stream(np.arange(10.0), np.where(lost, np.nan, 0.1), (~lost).astype(int))
    assert loss_runs(stream) == (2, 1, 3)
    assert numbers(stream).loss == pytest.approx(0.6)


def test_bursts_and_copies() -> None:
    found = measured(
        DirectionProfile(0.045, loss=GilbertElliott(0.02, 0.2), duplicate=0.1), 100_000
    )
    assert found.loss == pytest.approx(1 / 11, rel=0.1)
    assert np.mean(found.runs) == pytest.approx(5.0, rel=0.1)
    assert found.duplicated == pytest.approx(0.1 * 10 / 11, rel=0.05)


def test_what_is_not_known_is_not_a_number() -> None:
    found = measured(DirectionProfile(loss=1.0), 10)
    assert (found.loss, found.runs) == (1.0, (10,))
    assert all(isnan(value) for value in (found.mean, found.p99, found.correlation))
    assert isnan(measured(DirectionProfile(0.045), 10).correlation)
