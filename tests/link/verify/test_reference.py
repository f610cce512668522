"""The reference that links are verified by: a second opinion that agrees with the model."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from cloudrc.assembly import link_profile
from cloudrc.config.load import load_profile
from cloudrc.config.shipped import names
from cloudrc.link.profile import (
    Blackout,
    Change,
    DirectionProfile,
    GilbertElliott,
    Trace,
    mean_loss,
)
from cloudrc.link.verify.plan import believed, bounds, chances, spread
from cloudrc.link.verify.reference import Fates, draw, instants, overtaken
from tests.link.conftest import PERIOD_NS, flow

COUNT = 30_000
BURSTS = GilbertElliott(0.02, 0.2, 0.7, 0.01, 0.030)
LINKS = {
    "uniform": DirectionProfile(0.045, 0.025),
    "normal": DirectionProfile(0.045, 0.010, "normal", 0.8),
    "pareto": DirectionProfile(0.020, 0.004, "pareto", 0.5, keep_order=True),
    "table": DirectionProfile(0.030, 0.004, "table", table=(-1.2, 0.0, 0.0, 1.2)),
    "bursts": DirectionProfile(0.030, 0.010, loss=BURSTS),
    "copies": DirectionProfile(0.030, 0.010, duplicate=0.2, loss=0.1),
    "copies in order": DirectionProfile(0.030, 0.020, duplicate=0.2, keep_order=True),
    "overtaking": DirectionProfile(0.050, 0.002, reorder=0.15),
    "bottleneck": DirectionProfile(0.010, 0.003, "normal", rate=250_000.0, keep_order=True),
}


def model(profile: DirectionProfile, count: int = COUNT, seed: int = 3) -> Fates:
    """What the model does to one long flow, in the reference's words."""
    copies = flow(profile, count, seed)
    there = np.array([bool(fate) for fate in copies])
    delay = np.array([min(fate, default=0) * 1e-9 for fate in copies])
    # Whole nanoseconds: what arrives at one instant has not overtaken.
    instants_ns = [n * PERIOD_NS + min(fate, default=0) for n, fate in enumerate(copies)]
    arrival = np.array(instants_ns, dtype=np.float64)
    late = overtaken(arrival, ~there)
    doubled = np.array([len(fate) > 1 for fate in copies])
    return Fates(there[None], delay[None], late[None], doubled[None])


def summary(fates: Fates) -> dict[str, float]:
    there = fates.arrived
    delays = fates.delay[there]
    steps = np.abs(np.diff(fates.delay, axis=1))[there[:, 1:] & there[:, :-1]]
    return {
        "loss": 1.0 - there.mean(),
        "mean": delays.mean(),
        "deviation": delays.std(),
        "variation": steps.mean(),
        "overtaken": fates.overtaken.sum() / there.sum(),
        "doubled": fates.doubled.sum() / there.sum(),
    }


def reference(profile: DirectionProfile, runs: int = 40, count: int = 1500) -> Fates:
    rng = np.random.default_rng(5)
    return draw(profile, instants(count, PERIOD_NS * 1e-9), 172, runs, rng)


@pytest.mark.parametrize("name", LINKS)
def test_model_and_reference_agree_though_they_share_no_chance(name: str) -> None:
    ours, theirs = summary(model(LINKS[name])), summary(reference(LINKS[name]))
    for quantity, value in theirs.items():
        unit = 0.01 if quantity in ("loss", "overtaken", "doubled") else 3e-4
        assert ours[quantity] == pytest.approx(value, rel=0.06, abs=unit), quantity


@pytest.mark.full
@pytest.mark.parametrize("way", ["uplink", "downlink"])
@pytest.mark.parametrize("name", names("profile"))
def test_a_million_draws_of_a_shipped_profile_match_it(
    name: str, way: str, figure: Callable[..., None]
) -> None:
    count = 1_000_000
    profile = link_profile(getattr(load_profile(name), way))
    ours, theirs = summary(model(profile, count)), summary(reference(profile, 1, count))
    off = 1e6 * abs(ours["mean"] - theirs["mean"])
    figure("a million draws of a profile: mean off by", off, "<=", 200.0, "us", count)
    for quantity, value in theirs.items():
        unit = 1e-3 if quantity in ("loss", "overtaken", "doubled") else 2e-4
        assert ours[quantity] == pytest.approx(value, rel=0.02, abs=unit), quantity


def test_a_time_line_is_followed() -> None:
    profile = DirectionProfile(
        0.01, changes=(Change(5.0, delay=0.05, loss=0.5),), blackouts=(Blackout(2.0, 1.0),)
    )
    fates = reference(profile, runs=3)
    assert fates.arrived[:, :200].all()
    assert not fates.arrived[:, 200:300].any()
    assert fates.delay[:, 300:500] == pytest.approx(0.01)
    assert fates.arrived[:, 500:].mean() == pytest.approx(0.5, abs=0.05)
    assert fates.delay[:, 500:][fates.arrived[:, 500:]] == pytest.approx(0.05)


def test_a_trace_is_followed() -> None:
    profile = DirectionProfile(trace=Trace((0.0, 1.0), (0.02, 0.07)))
    assert reference(profile, runs=1, count=200).delay[0] == pytest.approx(
        [0.02] * 100 + [0.07] * 100
    )


def test_the_chances_of_each_loss_are_those_of_the_model() -> None:
    lost = np.array([500 - model(LINKS["bursts"], 500, seed).arrived.sum() for seed in range(300)])
    pmf = chances([(500, BURSTS)])
    numbers = np.arange(501)
    mean = float((pmf * numbers).sum())
    assert pmf.sum() == pytest.approx(1.0)
    assert mean == pytest.approx(500 * mean_loss(BURSTS))
    assert lost.mean() == pytest.approx(mean, rel=0.1)
    deviation = float((pmf * numbers**2).sum() - mean**2) ** 0.5
    assert deviation == pytest.approx(spread(BURSTS) * 500**0.5, rel=0.03)
    assert lost.std() == pytest.approx(deviation, rel=0.12)


@pytest.mark.parametrize("loss", [0.0, 0.001, 0.05, 0.3, BURSTS, replace(BURSTS, loss_bad=1.0)])
@pytest.mark.parametrize("wrong", [-1.0, 1.0])
def test_a_loss_off_by_its_margin_is_almost_never_believed(
    loss: float | GilbertElliott, wrong: float
) -> None:
    margin = max(0.02, 0.25 * mean_loss(loss))
    allowed = bounds([(40_000, loss)], margin, 1e-3)
    assert believed([(40_000, loss)], allowed) > 0.99
    off = mean_loss(loss) + wrong * margin
    if off >= 0.0:
        assert believed([(40_000, off)], allowed) < 1.1e-3
