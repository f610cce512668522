"""Delay, loss, copies, order and damage of packets have the specified distributions."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from math import asin, erf, pi, sqrt
from typing import Any, Literal

import numpy as np
import pytest
from numpy.typing import NDArray

from cloudrc.link.draws import bit_flips, stream_key
from cloudrc.link.profile import DirectionProfile, GilbertElliott
from tests.link.conftest import MS, SIZE, bursts, delays, flow, link, losses

COUNT = 20_000
DELAY, JITTER, LOSS = 0.060, 0.005, 0.02
Array = NDArray[np.float64]


def uniform(z: Array) -> Array:
    return (z + 1) / 2


def normal(z: Array) -> Array:
    return np.array([0.5 * (1 + erf(one / sqrt(2))) for one in z])


def pareto(z: Array) -> Array:
    """Exponent 3, cut at its 99.9 % quantile; then mean 0 and standard deviation 1."""
    cut = 1e-3
    mean = 1.5 * (1 - cut ** (2 / 3)) / (1 - cut)
    square = 3 * (1 - cut ** (1 / 3)) / (1 - cut)
    raw = np.maximum(z * sqrt(square - mean**2) + mean, 1.0)
    return (1 - raw**-3.0) / (1 - cut)


@pytest.mark.parametrize("count", [100_000, pytest.param(1_000_000, marks=pytest.mark.full)])
@pytest.mark.parametrize(
    ("distribution", "cumulative", "deviation"),
    [("uniform", uniform, 1 / sqrt(3)), ("normal", normal, 1.0), ("pareto", pareto, 1.0)],
)
def test_many_draws_match_their_distribution(
    distribution: Literal["uniform", "normal", "pareto"],
    cumulative: Callable[[Any], Array],
    deviation: float,
    count: int,
    figure: Callable[..., None],
) -> None:
    fates = flow(DirectionProfile(DELAY, JITTER, distribution, loss=LOSS), count)
    root = sqrt(count)
    lost = np.array([not copies for copies in fates])
    off, most = abs(lost.mean() - LOSS), 4 * sqrt(LOSS * (1 - LOSS)) / root
    figure(f"{count:,} draws: loss off by", 100 * off, "<=", 100 * most, "%", count)
    sample = np.sort((np.array([one[0] for one in fates if one]) * 1e-9 - DELAY) / JITTER)
    off, most = abs(sample.mean()) * JITTER * 1e6, 4.04 * JITTER * 1e6 / root
    figure(f"{count:,} draws: mean off by", off, "<=", most, "us", count)
    assert sample.std() == pytest.approx(deviation, rel=10 / root)
    some = sample[:: count // 2000]
    share = np.linspace(0, 1, sample.size)[:: count // 2000]
    # Kolmogorov-Smirnov distance that one in a thousand seeds exceeds by chance.
    distance = np.abs(cumulative(some) - share).max()
    figure(f"{count:,} draws: from their distribution", distance, "<=", 1.97 / root, count=count)


@pytest.mark.parametrize(
    ("distribution", "correlation"), [("normal", 0.7), ("pareto", 0.5), ("uniform", 0.9)]
)
def test_correlated_jitter_keeps_its_distribution(
    distribution: Literal["uniform", "normal", "pareto"], correlation: float
) -> None:
    profile = DirectionProfile(0.045, 0.005, distribution)
    apart, alike = (delays(replace(profile, correlation=c), 3 * COUNT) for c in (0.0, correlation))
    assert alike.mean() == pytest.approx(0.045, abs=0.0002)
    assert alike.std() == pytest.approx(apart.std(), rel=0.04)
    shares = np.linspace(0.05, 0.95, 19)
    assert np.quantile(alike, shares) == pytest.approx(np.quantile(apart, shares), abs=0.0003)
    lag_one = np.corrcoef(alike[:-1], alike[1:])[0, 1]
    if distribution == "uniform":
        assert lag_one == pytest.approx(6 / pi * asin(correlation / 2), abs=0.02)
    assert lag_one > 0.3


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


def test_a_delay_below_zero_becomes_zero() -> None:
    sample = delays(DirectionProfile(0.010, 0.020), COUNT)
    assert sample.min() == 0.0
    assert np.mean(sample == 0.0) == pytest.approx(0.25, abs=0.01)


def test_independent_loss_comes_without_bursts() -> None:
    lost = losses(DirectionProfile(loss=0.1), COUNT)
    assert lost.mean() == pytest.approx(0.1, abs=4 * sqrt(0.09 / COUNT))
    assert np.mean(bursts(lost)) == pytest.approx(1 / 0.9, rel=0.05)


def test_200000_packets_have_the_specified_bursts(figure: Callable[..., None]) -> None:
    """All packets in the bad state are lost: loss 1/11, bursts of 5 packets."""
    lost = losses(DirectionProfile(loss=GilbertElliott(0.02, 0.2)), 200_000)
    lengths = bursts(lost)
    for name, measured, asked in (("loss", lost.mean(), 1 / 11), ("burst", np.mean(lengths), 5.0)):
        off = 100 * abs(measured / asked - 1)
        figure(f"Gilbert-Elliott: {name} off by", off, "<=", 10.0, "%", lost.size)


def test_the_bad_state_delays_what_it_does_not_lose() -> None:
    loss = GilbertElliott(0.1, 0.1, loss_bad=0.5, loss_good=0.0, delay_bad=0.040)
    fate = flow(DirectionProfile(0.030, loss=loss), COUNT)
    assert {copies for copies in fate} == {(), (30 * MS,), (70 * MS,)}
    assert fate.count(()) / COUNT == pytest.approx(0.25, abs=0.02)
    assert fate.count((70 * MS,)) / COUNT == pytest.approx(0.25, abs=0.02)


@pytest.mark.parametrize("certain", [{"loss": 1.0}, {"loss": GilbertElliott(1.0, 0.0)}])
def test_certain_loss_loses_everything(certain: dict[str, float | GilbertElliott]) -> None:
    assert set(flow(DirectionProfile(duplicate=1.0, **certain), 1000)) == {()}  # type: ignore[arg-type]


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


def test_damage_flips_one_bit_anywhere_by_counter_and_stream() -> None:
    profile, data = DirectionProfile(0.04, corrupt=0.2), bytes(SIZE)
    one, other, seven = link(profile, 7), link(profile, 7), link(profile, 8)
    damaged = [one.corrupted(1, 3, n, data) for n in range(COUNT)]
    places = [np.flatnonzero(np.unpackbits(np.frombuffer(d, np.uint8))) for d in damaged]
    hit = [int(place[0]) for place in places if place.size]
    assert max(place.size for place in places) == 1
    assert len(hit) / COUNT == pytest.approx(0.2, abs=5 * sqrt(0.2 * 0.8 / COUNT))
    shares, _ = np.histogram(hit, bins=8, range=(0, 8 * SIZE))
    assert shares.min() > 0.8 * len(hit) / 8
    assert one.counts()["corrupted"] == len(hit)
    assert damaged[:600] == [other.corrupted(1, 3, n, data) for n in reversed(range(600))][::-1]
    assert damaged[:600] != [other.corrupted(2, 3, n, data) for n in range(600)]
    assert damaged[:600] != [seven.corrupted(1, 3, n, data) for n in range(600)]
    assert {one.corrupted(1, 3, n, b"") for n in range(50)} == {b""}
    key = stream_key(1, True, 1, 3)
    assert (len(bit_flips(key, 0, 1.0)), bit_flips(key, 0, 0.0)) == (256, {})


def test_damage_shifts_no_other_draw() -> None:
    profile = DirectionProfile(
        0.04, 0.01, "uniform", 0.5, GilbertElliott(0.1, 0.3), 0.1, 0.1, corrupt=0.2
    )
    assert flow(profile, 600) == flow(replace(profile, corrupt=0.0), 600)
    assert link(profile).corrupts
    assert not link(replace(profile, corrupt=0.0)).corrupts
