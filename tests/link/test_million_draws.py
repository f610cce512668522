"""A million draws of a seed follow the specified distribution."""

from __future__ import annotations

from collections.abc import Callable
from math import erf, sqrt
from typing import Any, Literal

import numpy as np
import pytest
from numpy.typing import NDArray

from cloudrc.link.profile import DirectionProfile, GilbertElliott
from tests.link.conftest import SIZE, TELEMETRY, link

COUNT = 1_000_000
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


def drawn(profile: DirectionProfile, count: int = COUNT) -> list[int]:
    """Return the delay of each packet [ns]; -1 for a lost one."""
    send = link(profile).send
    fates = (send(1, TELEMETRY, n, SIZE, 0) for n in range(count))
    return [fate[0] if fate else -1 for fate in fates]


@pytest.mark.parametrize(
    ("distribution", "cumulative", "deviation"),
    [("uniform", uniform, 1 / sqrt(3)), ("normal", normal, 1.0), ("pareto", pareto, 1.0)],
)
def test_a_million_draws_match_their_distribution(
    distribution: Literal["uniform", "normal", "pareto"],
    cumulative: Callable[[Any], Array],
    deviation: float,
    figure: Callable[..., None],
) -> None:
    fates = np.array(drawn(DirectionProfile(DELAY, JITTER, distribution, loss=LOSS)))
    lost = fates < 0
    off = abs(lost.mean() - LOSS)
    figure("a million draws: loss off by", 100 * off, "<=", 0.056, "%", COUNT)
    assert lost.mean() == pytest.approx(LOSS, abs=4 * sqrt(LOSS * (1 - LOSS) / COUNT))
    sample = np.sort((fates[~lost] * 1e-9 - DELAY) / JITTER)
    figure(
        "a million draws: mean off by", abs(sample.mean()) * JITTER * 1e6, "<=", 20.2, "us", COUNT
    )
    assert sample.mean() == pytest.approx(0.0, abs=4 / sqrt(sample.size))
    assert sample.std() == pytest.approx(deviation, rel=0.01)
    some = sample[:: COUNT // 2000]
    share = np.linspace(0, 1, sample.size)[:: COUNT // 2000]
    # Kolmogorov-Smirnov distance that one in a thousand seeds exceeds by chance.
    distance = np.abs(cumulative(some) - share).max()
    figure("a million draws: from their distribution", distance, "<=", 1.97e-3, count=COUNT)
    assert distance < 1.95 / sqrt(sample.size)


def test_a_million_fates_have_the_bursts_asked_for() -> None:
    fates = np.array(drawn(DirectionProfile(DELAY, loss=GilbertElliott(0.01, 0.1, 0.6, 0.005))))
    share_bad = 0.01 / 0.11
    assert np.mean(fates < 0) == pytest.approx(share_bad * 0.6 + (1 - share_bad) * 0.005, rel=0.02)


def test_200000_packets_have_the_specified_loss_and_burst_length(
    figure: Callable[..., None],
) -> None:
    """All packets in the bad state are lost: loss 1/11, bursts of 5 packets, to 10 %."""
    lost = np.array(drawn(DirectionProfile(loss=GilbertElliott(0.02, 0.2)), 200_000)) < 0
    edges = np.flatnonzero(np.diff(np.concatenate(([0], lost, [0]))))
    lengths = edges[1::2] - edges[::2]
    for name, measured, asked in (("loss", lost.mean(), 1 / 11), ("burst", lengths.mean(), 5.0)):
        off = 100 * abs(measured / asked - 1)
        figure(f"Gilbert-Elliott: {name} off by", off, "<=", 10.0, "%", lost.size)
    assert lost.mean() == pytest.approx(1 / 11, rel=0.1)
    assert lengths.mean() == pytest.approx(5.0, rel=0.1)
