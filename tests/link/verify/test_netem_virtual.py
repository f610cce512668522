"""Honest netem links are believed, false ones not: drawn as the kernel draws, without a kernel."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from cloudrc.assembly import link_profile
from cloudrc.cli.link_verify import find_experiment
from cloudrc.cli.link_verify_run import _notes, plan
from cloudrc.config.load import load_profile
from cloudrc.config.shipped import names
from cloudrc.link.profile import DirectionProfile, GilbertElliott, mean_loss
from cloudrc.link.verify.causes import Evidence, Findings
from cloudrc.link.verify.expect import netem_makes
from cloudrc.link.verify.plan import spread
from cloudrc.link.verify.reference import draw, instants
from tests.link.conftest import PERIOD_NS
from tests.link.verify.conftest import Asked, VirtualNetem, can, probe

COUNT = 120_000
WAYS = ("uplink", "downlink")
SHIPPED = [
    (name, way)
    for name in names("profile")
    for way in WAYS
    if can(link_profile(getattr(load_profile(name), way)))
]
QUICK = ("paper-p2", "5g")
BURSTS = GilbertElliott(0.02, 0.2, 0.9, 0.02)
LINKS = {
    "a correlation": DirectionProfile(0.080, 0.020, correlation=0.9),
    "a correlation in order": DirectionProfile(0.080, 0.020, "pareto", 0.5, keep_order=True),
    "a bottleneck behind": DirectionProfile(0.080, 0.020, rate=250e3, keep_order=True),
    "copies and a bottleneck": DirectionProfile(
        0.080, 0.020, rate=500e3, keep_order=True, duplicate=0.3
    ),
    "copies and losses": DirectionProfile(0.045, 0.010, loss=0.2, duplicate=0.3),
    "copies and bursts": DirectionProfile(0.045, 0.010, loss=BURSTS, duplicate=0.4),
    "copies, losses and damage": DirectionProfile(0.045, loss=0.1, duplicate=0.5, corrupt=0.1),
    "copies, bursts and damage": DirectionProfile(0.045, loss=BURSTS, duplicate=0.5, corrupt=0.1),
    "damage": DirectionProfile(0.045, loss=0.1, corrupt=0.1),
}


def summary(profile: DirectionProfile, count: int = COUNT) -> dict[str, float]:
    """What the kernel's draws come to."""
    netem = VirtualNetem(profile, 7)
    fates = [netem.send(1, 1, n, 172, n * PERIOD_NS) for n in range(count)]
    delays = np.array([(min(f) - n * PERIOD_NS) * 1e-9 for n, f in enumerate(fates) if f])
    return {
        "loss": sum(not fate for fate in fates) / count,
        "doubled": sum(len(fate) > 1 for fate in fates) / len(delays),
        "mean": float(delays.mean()),
        "deviation": float(delays.std()),
        "variation": float(np.abs(np.diff(delays)).mean()),
    }


@pytest.mark.parametrize("name", LINKS)
def test_what_netem_is_said_to_make_is_what_the_kernel_draws(name: str) -> None:
    found = summary(LINKS[name])
    made = netem_makes(LINKS[name])
    assert (made.correlation, made.corrupt) == (0.0, 0.0)
    scatter = 4.0 * spread(made.loss) / COUNT**0.5
    assert mean_loss(made.loss) == pytest.approx(found["loss"], abs=scatter + 1e-4)
    assert made.duplicate == pytest.approx(found["doubled"], rel=0.02, abs=1e-3)
    sent = instants(2000, PERIOD_NS * 1e-9)
    there, delay, _, _ = draw(made, sent, 172, 30, np.random.default_rng(5))
    delays = np.where(there, delay, np.nan)
    assert float(np.nanmean(delays)) == pytest.approx(found["mean"], rel=0.02)
    assert float(np.nanstd(delays)) == pytest.approx(found["deviation"], rel=0.03, abs=1e-6)
    steps = np.abs(np.diff(delays, axis=1))
    rough = float(steps[np.isfinite(steps)].mean())
    if not LINKS[name].loss:  # the others leave out what is lost between two
        assert rough == pytest.approx(found["variation"], rel=0.03, abs=1e-6)


def test_the_kernel_correlates_nothing_and_keeps_the_width() -> None:
    found = summary(LINKS["a correlation"])
    assert found["deviation"] == pytest.approx(0.020 / 3**0.5, rel=0.01)
    assert found["variation"] == pytest.approx(0.040 / 3, rel=0.01), "of independent draws"


def of_netem(name: str, *settings: str) -> dict[str, Asked]:
    """What `link verify --shaper netem` sends and expects."""
    asked = plan(find_experiment(name, list(settings)), None, "netem")
    return {way: Asked(one.plan.profile, one.plan, one.trains) for way, one in asked.items()}


def shaped(
    asked: Asked, real: DirectionProfile, seed: int, applied: DirectionProfile | None = None
) -> Findings:
    evidence = Evidence("netem", applied=applied and netem_makes(applied), layers=1)
    return probe(asked, real, seed, evidence=evidence, link=VirtualNetem(real, seed))


def doubts(findings: Findings) -> list[str]:
    return [
        f"{row.name} {row.verdict}"
        for row in findings.rows
        if row.verdict != "ok" and (row.name, row.verdict) != ("rate", "open")
    ]


@pytest.mark.parametrize(
    ("name", "way"),
    [
        pytest.param(*one, marks=[] if one[0] in QUICK else pytest.mark.full, id="-".join(one))
        for one in SHIPPED
    ],
)
def test_an_honest_netem_is_believed(name: str, way: str) -> None:
    asked = of_netem(name)[way]
    real = link_profile(getattr(load_profile(name), way))
    assert [doubts(shaped(asked, real, seed, real)) for seed in range(2)] == [[]] * 2


@pytest.mark.parametrize(
    ("settings", "real", "row"),
    [
        (["jitter_ms=20", "correlation=0.9"], {"jitter": 0.022}, "deviation"),
        (["jitter_ms=20", "correlation=0.9"], {"jitter": 0.018}, "deviation"),
        (["jitter_ms=20", "correlation=0.9"], {"delay": 0.0842}, "mean"),
        (["loss=0.2", "duplicate=0.3"], {"loss": 0.25}, "loss"),
        (["loss=0.2", "duplicate=0.3"], {"loss": 0.15}, "loss"),
        (["loss=0.2", "duplicate=0.3"], {"duplicate": 0.20}, "duplicated"),
    ],
)
def test_a_netem_that_is_off_is_not_believed(
    settings: list[str], real: dict[str, float], row: str
) -> None:
    settings = ["delay_ms=80", *settings]
    words = [f"link.{way}.{one}" for way in WAYS for one in settings]
    asked = of_netem("ideal", *words)["uplink"]
    true = link_profile(find_experiment("ideal", words).uplink)
    assert doubts(shaped(asked, true, 1)) == []
    for seed in range(5):
        assert f"{row} off" in doubts(shaped(asked, replace(true, **real), seed))


def test_a_correlation_that_netem_ignores_is_noted() -> None:
    experiment = find_experiment("satellite", [])
    said = _notes(experiment, plan(experiment, 60.0, "netem"), "netem")
    assert "uplink: correlation 0.9 NOT JUDGED: netem realises almost none of it" in said
    assert not [one for one in _notes(experiment, plan(experiment, 60.0), "relay") if "corr" in one]
