"""How strict the standing check is: true links are believed, those off by a margin never."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest

from cloudrc.assembly import link_profile
from cloudrc.config.load import load_profile
from cloudrc.config.shipped import names
from cloudrc.link.profile import DirectionProfile, GilbertElliott, Trace
from tests.link.verify.conftest import (
    HANDOVER,
    LOSSY,
    P1,
    SATELLITE,
    arrivals,
    believed,
    checked,
    downlink,
    hearing,
    moments,
    newest,
)

WAYS = ("uplink", "downlink")


def asked(name: str, way: str) -> DirectionProfile:
    return link_profile(getattr(load_profile(name), way))


@pytest.mark.parametrize("way", WAYS)
@pytest.mark.parametrize("name", names("profile"))
def test_known_draws_prove_a_true_link_within_half_a_minute(name: str, way: str) -> None:
    profile, up = asked(name, way), way == "uplink"
    records, faults = checked(hearing(profile, up), arrivals(profile, 33.0, uplink=up))
    assert faults == []
    assert {record.verdict for record in records} <= {"ok", "open", "told"}
    assert believed(records)


def test_an_undecidable_loss_is_skipped_with_its_sample_size() -> None:
    profile = asked("lossy", "downlink")
    records, faults = checked(downlink(profile), arrivals(profile, 60.0, seed=2))
    last = newest(records)
    assert faults == []
    assert last["loss"].verdict == "told"
    assert 26_000 < last["loss_takes"].asked < 1e6, "bursts are rare"
    assert last["mean"].verdict == "told"
    assert last["datagrams"].asked < 26_000
    assert last["datagrams"].measured == pytest.approx(5000, abs=900)
    losing = replace(profile, loss=0.2)
    _, faults = checked(downlink(profile), arrivals(losing, 60.0, seed=2))
    assert [fault.code for fault in faults] == ["link"], "what is far off is told all the same"


MARGINS = {
    "2 ms slower": (P1, replace(P1, delay=P1.delay + 0.002)),
    "2 ms quicker": (P1, replace(P1, delay=P1.delay - 0.002)),
    "5 % slower": (SATELLITE, replace(SATELLITE, delay=SATELLITE.delay * 1.05)),
    "more jitter": (P1, replace(P1, jitter=P1.jitter * 1.1)),
    "less jitter": (P1, replace(P1, jitter=P1.jitter * 0.9)),
    "2 % lost": (P1, replace(P1, loss=0.02)),
    "more bursts": (LOSSY, replace(LOSSY, loss=GilbertElliott(0.0138, 0.1, 0.6, 0.005, 0.04))),
    "fewer bursts": (LOSSY, replace(LOSSY, loss=GilbertElliott(0.006, 0.1, 0.6, 0.005, 0.04))),
    "nothing damaged": (replace(P1, corrupt=0.1), P1),
    "another time line": (
        HANDOVER,
        replace(HANDOVER, changes=tuple(replace(one, at=one.at + 3) for one in HANDOVER.changes)),
    ),
    "more jitter, changing": (
        HANDOVER,
        replace(
            HANDOVER,
            jitter=HANDOVER.jitter * 1.1,
            changes=tuple(
                replace(one, jitter=one.jitter and 1.1 * one.jitter) for one in HANDOVER.changes
            ),
        ),
    ),
}


@pytest.mark.parametrize("seed", [1, 2])
@pytest.mark.parametrize("fault", MARGINS)
def test_a_link_that_is_off_by_its_margin_is_never_believed(fault: str, seed: int) -> None:
    asked, real = MARGINS[fault]
    records, _ = checked(downlink(asked), arrivals(real, 80.0 if asked is P1 else 40.0, seed=seed))
    assert not [one for one in moments(records) if believed(one)]


def test_what_is_damaged_is_lost_to_the_tunnel_and_no_fault() -> None:
    profile = replace(P1, corrupt=0.1)
    for seed in (1, 2):
        records, faults = checked(downlink(profile), arrivals(profile, 60.0, seed=seed))
        assert faults == []
        assert newest(records)["loss"].asked == pytest.approx(0.1, abs=0.02)
        assert newest(records)["loss"].verdict == ("ok" if seed == 1 else "open"), "that takes more"


@pytest.mark.parametrize("joined", [0.0, 12.0, 200.0])
def test_a_time_line_is_judged_and_what_was_not_watched_is_told(joined: float) -> None:
    """Who joins late finds out by the delays where on its time line the link is."""
    heard = [one for one in arrivals(HANDOVER, joined + 45.0) if one.counter >= joined * 100]
    records, faults = checked(downlink(HANDOVER), heard)
    assert faults == []
    assert believed(records)
    watched = newest(records)["time_line"]
    assert watched.verdict == "told"
    share = {0.0: 18.3 / 20.3, 12.0: 6.3 / 20.3, 200.0: 0.0}[joined]
    assert watched.measured == pytest.approx(share, abs=0.01)


def test_a_time_line_of_other_draws_is_judged_piece_by_piece() -> None:
    records, faults = checked(downlink(HANDOVER), arrivals(HANDOVER, 24.0, seed=2))
    assert faults == []
    changing = newest(records)
    assert {changing["mean"].verdict, changing["loss"].verdict} <= {"ok", "open"}
    late = replace(
        HANDOVER,
        delay=0.060,
        changes=tuple(
            replace(one, delay=one.delay and one.delay + 0.035) for one in HANDOVER.changes
        ),
    )
    _, faults = checked(downlink(HANDOVER), arrivals(late, 24.0, seed=2))
    assert [fault.code for fault in faults] == ["link"]


def test_a_trace_is_judged() -> None:
    wave = [0.03 + 0.02 * math.sin(n / 7.0) for n in range(600)]
    trace = Trace(tuple(n * 0.05 for n in range(600)), tuple(wave))
    profile = DirectionProfile(trace=trace)
    records, faults = checked(downlink(profile), arrivals(profile, 28.0, overhead=3e-4))
    assert faults == []
    assert believed(records)
    slow = replace(profile, trace=replace(trace, delays=tuple(one + 0.004 for one in wave)))
    records, faults = checked(downlink(profile), arrivals(slow, 28.0))
    assert not believed(records)


def test_single_datagrams_do_not_measure_a_bottleneck() -> None:
    records, _ = checked(downlink(SATELLITE), arrivals(SATELLITE, 33.0))
    assert newest(records)["rate"].verdict == "told"
