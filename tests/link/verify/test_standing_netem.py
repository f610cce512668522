"""The standing check of links that netem shapes, drawn as the kernel draws, both ways."""

from __future__ import annotations

from dataclasses import replace

import pytest

from cloudrc.assembly import link_profile
from cloudrc.config.load import load_profile
from cloudrc.config.shipped import names
from cloudrc.link.profile import DirectionProfile
from cloudrc.link.verify.measure import Block
from cloudrc.link.verify.monitor import Basis
from cloudrc.link.verify.twin import Stream
from tests.conftest import nightly
from tests.link.verify.conftest import (
    arrivals,
    believed,
    can,
    checked,
    hearing,
    moments,
    newest,
    punctual,
)

WAYS = ("uplink", "downlink")
SECONDS = {
    "ideal": 20, "paper-p1": 50, "handover": 50, "5g": 55, "lte": 55, "paper-p3": 60, "wifi": 85,
    "paper-p2": 90, "satellite": 240,
}  # fmt: skip
"""How long it takes, whatever the ends may add [s]: nobody knows netem's draws."""
QUICK = ("ideal", "lte")
CORRELATED = DirectionProfile(0.080, 0.020, correlation=0.6)
COPIED = DirectionProfile(0.045, 0.010, loss=0.2, duplicate=0.3)


def asked(name: str, way: str) -> DirectionProfile:
    return link_profile(getattr(load_profile(name), way))


def test_all_that_netem_can_do_is_tried() -> None:
    shipped = {name for name in names("profile") if can(asked(name, "uplink"))}
    assert shipped == set(SECONDS)


@pytest.mark.parametrize("way", WAYS)
@pytest.mark.parametrize(
    "name",
    [
        pytest.param(name, id=name, marks=[] if name in QUICK else pytest.mark.full)
        for name in SECONDS
    ],
)
def test_an_honest_netem_is_believed_in_time_and_never_faulted(name: str, way: str) -> None:
    profile, up = asked(name, way), way == "uplink"
    for seed in (2, 3):
        heard = arrivals(profile, 268.0, seed=seed, uplink=up, netem=True)
        records, faults = checked(hearing(profile, up), heard)
        assert faults == []
        found = moments(records)
        first = next(n for n, moment in enumerate(found) if believed(moment))
        assert found[first][0].stamp_ns * 1e-9 < SECONDS[name]
        assert all(believed(moment) for moment in found[first:])
        assert ("correlation" in newest(records)) == (profile.correlation > 0.0)


def test_lte_up_is_judged_in_full_by_ends_that_wake_in_time() -> None:
    """Of ends whose lateness nobody knows its mean takes more datagrams than are kept."""
    profile = asked("lte", "uplink")
    heard = arrivals(profile, 150.0, seed=2, uplink=True, netem=True)
    unknown = newest(checked(hearing(profile, True), heard)[0])
    assert unknown["mean"].verdict == "told"
    assert 26_000 < unknown["mean_takes"].asked < 40_000
    punctually = newest(checked(hearing(profile, True), punctual(heard))[0])
    assert punctually["mean"].verdict == "ok"
    assert "mean_takes" not in punctually


OFF = {
    "2 ms slower": (asked("5g", "downlink"), {"delay": 0.010}),
    "2 ms quicker": (asked("5g", "downlink"), {"delay": 0.006}),
    "5 % slower": (CORRELATED, {"delay": 0.0842}),
    "more jitter": (CORRELATED, {"jitter": 0.022}),
    "less jitter": (CORRELATED, {"jitter": 0.018}),
    "more jitter in order": (asked("satellite", "downlink"), {"jitter": 0.0088}),
    "less jitter in order": (asked("satellite", "downlink"), {"jitter": 0.0072}),
    "more loss": (COPIED, {"loss": 0.25}),
    "less loss": (COPIED, {"loss": 0.15}),
    "fewer copies": (COPIED, {"duplicate": 0.2}),
}


@pytest.mark.parametrize("seed", [2, *nightly(3)])
@pytest.mark.parametrize("fault", OFF)
def test_a_netem_that_is_off_by_its_margin_is_never_believed(fault: str, seed: int) -> None:
    profile, changed = OFF[fault]
    real = replace(profile, **changed)
    seconds = 240.0 if "order" in fault else 160.0 if profile is COPIED else 70.0
    for flight in (
        arrivals(real, seconds, seed=seed, netem=True),
        punctual(arrivals(real, seconds, seed=seed, netem=True, overhead=1e-4)),
    ):
        records, _ = checked(hearing(profile, False), flight)
        assert not [one for one in moments(records) if believed(one)]


@pytest.mark.parametrize("profile", [CORRELATED, COPIED], ids=["correlation", "copies"])
def test_by_whom_a_link_is_shaped_shows_in_what_is_heard(profile: DirectionProfile) -> None:
    """A relay of another seed is none that netem would make, and judged by what was asked."""
    for netem in (False, True):
        heard = arrivals(profile, 160.0, seed=2, netem=netem)
        records, faults = checked(hearing(profile, False), heard)
        assert faults == []
        assert believed(records), newest(records)
        assert ("correlation" in newest(records)) == (netem and profile.correlation > 0.0)


def test_without_delays_the_shaper_of_the_own_pod_tells() -> None:
    basis = Basis(CORRELATED, None, Stream(1, False, 4, 88))
    heard = Block(sent=5000, arrived=5000)
    for by_netem in (False, True):
        basis.by_netem = by_netem
        told = {row.name for row in basis.judge(heard, Block()).rows}
        assert ("correlation" in told) == by_netem
