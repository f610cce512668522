"""Delay, loss, duplication and reordering have the specified distributions."""

from __future__ import annotations

from math import asin, pi, sqrt

import numpy as np
import pytest

from cloudrc.link.profile import DirectionProfile, GilbertElliott
from tests.link.conftest import MS, bursts, delays, flow, losses

COUNT = 20_000


def test_uniform_jitter_is_a_half_width() -> None:
    sample = delays(DirectionProfile(0.045, 0.025), COUNT)
    assert 0.020 <= sample.min() < 0.0201
    assert 0.0699 < sample.max() <= 0.070
    assert sample.mean() == pytest.approx(0.045, abs=0.0004)
    assert sample.std() == pytest.approx(0.025 / sqrt(3), rel=0.02)


@pytest.mark.parametrize("correlation", [0.0, 0.7])
def test_normal_jitter_is_a_standard_deviation(correlation: float) -> None:
    sample = delays(DirectionProfile(0.045, 0.005, "normal", correlation), COUNT)
    assert sample.mean() == pytest.approx(0.045, abs=0.0003)
    assert sample.std() == pytest.approx(0.005, rel=0.03)
    assert np.mean(sample > 0.045 + 1.96 * 0.005) == pytest.approx(0.025, abs=0.006)


@pytest.mark.parametrize("correlation", [0.0, 0.5])
def test_pareto_jitter_has_its_mean_deviation_and_quantiles(correlation: float) -> None:
    """With q = s^(-1/3), 0.001 < s < 1: mean of q 1.48649, deviation 0.70218, so that a delay of
    45 ms with 5 ms of jitter has its median (s = 0.5005) at 43.38 ms, its 99 % quantile
    (s = 0.01099) at 66.44 ms and its bounds (s = 1, 0.001) at 41.54 ms and 105.62 ms.
    """
    sample = delays(DirectionProfile(0.045, 0.005, "pareto", correlation), 2 * COUNT)
    assert sample.mean() == pytest.approx(0.045, abs=0.0001)
    assert sample.std() == pytest.approx(0.005, rel=0.04)
    assert np.median(sample) == pytest.approx(0.04338, abs=0.0001)
    assert np.quantile(sample, 0.99) == pytest.approx(0.06644, abs=0.001)
    assert 0.041535 < sample.min() < 0.04154
    assert 0.095 < sample.max() < 0.10563


def test_a_delay_below_zero_becomes_zero() -> None:
    sample = delays(DirectionProfile(0.010, 0.020), COUNT)
    assert sample.min() == 0.0
    assert np.mean(sample == 0.0) == pytest.approx(0.25, abs=0.01)


@pytest.mark.parametrize("correlation", [0.0, 0.5, 0.9])
def test_correlated_uniform_jitter_stays_uniform(correlation: float) -> None:
    sample = delays(DirectionProfile(0.045, 0.025, correlation=correlation), 3 * COUNT)
    lag_one = np.corrcoef(sample[:-1], sample[1:])[0, 1]
    assert lag_one == pytest.approx(6 / pi * asin(correlation / 2), abs=0.02)
    shares, _ = np.histogram(sample, bins=10, range=(0.020, 0.070))
    assert shares / sample.size == pytest.approx([0.1] * 10, abs=0.012)


@pytest.mark.parametrize("seed", [1, 2, 3])
def test_independent_loss_has_its_rate_and_no_bursts(seed: int) -> None:
    lost = losses(DirectionProfile(loss=0.1), COUNT, seed)
    assert lost.mean() == pytest.approx(0.1, abs=4 * sqrt(0.09 / COUNT))
    assert np.mean(bursts(lost)) == pytest.approx(1 / 0.9, rel=0.05)


def test_burst_loss_has_its_share_and_length() -> None:
    """2e5 packets: mean loss 0.02 / (0.02 + 0.2) = 1/11, mean burst 1 / 0.2 = 5 packets."""
    lost = losses(DirectionProfile(loss=GilbertElliott(0.02, 0.2)), 200_000)
    assert lost.mean() == pytest.approx(1 / 11, rel=0.05)
    assert np.mean(bursts(lost)) == pytest.approx(5.0, rel=0.05)


def test_the_bad_state_delays_what_it_does_not_lose() -> None:
    loss = GilbertElliott(0.1, 0.1, loss_bad=0.5, loss_good=0.0, delay_bad=0.040)
    fate = flow(DirectionProfile(0.030, loss=loss), COUNT)
    assert {copies for copies in fate} == {(), (30 * MS,), (70 * MS,)}
    assert fate.count(()) / COUNT == pytest.approx(0.25, abs=0.02)
    assert fate.count((70 * MS,)) / COUNT == pytest.approx(0.25, abs=0.02)


def test_a_copy_has_a_delay_of_its_own() -> None:
    fate = flow(DirectionProfile(0.045, 0.025, duplicate=0.2), COUNT)
    pairs = np.array([copies for copies in fate if len(copies) == 2])
    assert len(pairs) / COUNT == pytest.approx(0.2, abs=0.01)
    assert pairs[:, 1].mean() * 1e-9 == pytest.approx(0.045, abs=0.001)
    assert abs(np.corrcoef(pairs.T)[0, 1]) < 0.05


def test_what_overtakes_has_no_delay() -> None:
    profile = DirectionProfile(0.045, 0.005, reorder=0.1, loss=GilbertElliott(0, 0, delay_bad=1))
    fate = flow(profile, COUNT)
    assert fate.count((0,)) / COUNT == pytest.approx(0.1, abs=0.01)
    assert min(copies[0] for copies in fate if copies != (0,)) >= 40 * MS
    always_bad = GilbertElliott(1.0, 0.0, loss_bad=0.0, delay_bad=0.040)
    assert set(flow(DirectionProfile(0.030, reorder=1.0, loss=always_bad), 100)) == {(0,)}


@pytest.mark.parametrize("certain", [{"loss": 1.0}, {"loss": GilbertElliott(1.0, 0.0)}])
def test_certain_loss_loses_everything(certain: dict[str, float | GilbertElliott]) -> None:
    assert set(flow(DirectionProfile(duplicate=1.0, **certain), 1000)) == {()}  # type: ignore[arg-type]


@pytest.mark.parametrize("correlation", [0.0, 0.6])
def test_a_table_is_drawn_from_about_its_mean(correlation: float) -> None:
    """A quarter of the packets is late by 1.73 jitters; the others are early by 0.58."""
    table = (-1 / sqrt(3),) * 3 + (sqrt(3),)
    profile = DirectionProfile(0.045, 0.005, "table", correlation, table=table)
    sample = delays(profile, COUNT)
    assert set(np.round(sample * 1e9)) == {round(45e6 + 5e6 * value) for value in set(table)}
    assert sample.mean() == pytest.approx(0.045, abs=0.0002)
    assert sample.std() == pytest.approx(0.005, rel=0.02)
    lag_one = np.corrcoef(sample[:-1], sample[1:])[0, 1]
    assert (lag_one > 0.3) if correlation else (abs(lag_one) < 0.03)
