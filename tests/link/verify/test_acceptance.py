# SPDX-License-Identifier: Apache-2.0

"""Verdicts and named causes for whole links in virtual time."""

from dataclasses import replace

import numpy as np
import pytest

from cloudrc.config.shipped import names
from cloudrc.link.profile import DirectionProfile, Radio
from cloudrc.link.verify import verdict_of
from cloudrc.link.verify.causes import Findings, ShaperFacts, find_causes
from cloudrc.link.verify.judge import Flow, look_twice
from cloudrc.link.verify.probe import PROBE, plan_probes
from tests.conftest import nightly
from tests.link.profiles import changed, profile_of
from tests.link.verify.conftest import asked, random_profile, rows_of, verify

PAPER = asked("paper-p2", "uplink")
LOSING = profile_of(0.045, 0.025, loss=0.05)
NARROW = profile_of(0.020, 0.002, rate=2e6, queue_packets=200, keep_order=True)
NOTHING = profile_of()


def doubts(rows):
    return [(row.name, row.verdict) for row in rows if row.verdict not in ("ok", "told")]


@pytest.mark.promise("verify-tells-the-link")
@pytest.mark.parametrize("count", [60, *nightly(200)])
def test_every_honest_link_is_verified(count):
    rng = np.random.default_rng(1)
    links = [asked(name, way) for name in names("profile") for way in ("uplink", "downlink")]
    links += [random_profile(rng) for _ in range(count - len(links))]
    found = {link: doubts(rows_of(link, link)) for link in links}
    assert {link: why for link, why in found.items() if why} == {}


def netem(**facts):
    return ShaperFacts(**{"shaper": "netem", "layers": 1, **facts})


# What is requested, and what both directions have in its place.
FAULTS = {
    "doubled_delay": (PAPER, {"delay": 0.090}),
    "halved_delay": (PAPER, {"delay": 0.0225, "jitter": 0.0125}),
    "wrong_jitter": (PAPER, {"jitter": 0.0225}),
    "no_loss": (LOSING, {"loss": 0.0}),
    "more_loss": (LOSING, {"loss": 0.15}),
    "order_kept": (PAPER, {"keep_order": True}),
    "rate_ignored": (NARROW, {"rate": None}),
    "order_broken": (NARROW, {"keep_order": False, "jitter": 0.015}),
    "wrong_duplicates": (PAPER, {"duplicate": 0.1}),
}


@pytest.mark.promise("verify-tells-the-link")
@pytest.mark.parametrize("fault", FAULTS)
def test_a_seeded_fault_is_named(fault):
    profile, values = FAULTS[fault]
    both = changed(profile, **values)
    assert {cause.code for cause in find_causes(verify(profile, both, both, netem()))} == {fault}


OFF = {
    "slower": (PAPER, {"delay_ms": 1.06 * PAPER.delay_ms}, "mean"),
    "less jitter": (PAPER, {"jitter_ms": 0.9 * PAPER.jitter_ms}, "deviation"),
    "damaged": (PAPER, {"corrupt": 0.05}, "loss"),
    "other jitter": (PAPER, {"distribution": "normal", "jitter": 0.0144}, "distribution"),
    "faster": (NARROW, {"rate": 2.6e6}, "rate"),
}


@pytest.mark.parametrize("name", OFF)
def test_a_link_beyond_its_tolerance_is_off(name):
    profile, values, quantity = OFF[name]
    assert (quantity, "off") in doubts(rows_of(profile, changed(profile, **values)))


def test_netem_is_verified_unless_it_delays_twice_as_long():
    profile = profile_of(0.08, 0.02, correlation=0.9)
    assert doubts(rows_of(profile, profile, netem=True)) == []
    assert ("mean", "off") in doubts(rows_of(profile, changed(profile, delay=0.16), netem=True))


@pytest.mark.parametrize(
    ("real", "causes"),
    [
        ({}, ["throttled", "wrong_delay"]),
        ({"delay_ms": 1.06 * PAPER.delay_ms, "loss": 0.3}, ["throttled", "wrong_delay"]),
        ({"delay_ms": PAPER.delay_ms / 3, "keep_order": True}, ["order_kept"]),
    ],
)
def test_a_lack_of_cpu_is_named_beside_other_faults(real, causes):
    known = ShaperFacts("relay", starved="500 datagrams not read in time")
    stall = 0.0 if "keep_order" in real else 0.04
    rows = rows_of(PAPER, changed(PAPER, **real), stall=stall)
    assert [one.code for one in find_causes({"uplink": Findings(rows, known)})] == causes


SLOW, DEAF = changed(PAPER, delay=0.090), changed(PAPER, loss=1.0)


@pytest.mark.promise("verify-tells-the-link")
@pytest.mark.parametrize(
    ("up", "down", "known", "code", "way"),
    [
        (PAPER, changed(PAPER, loss=0.2), netem(), "more_loss", "downlink"),
        (SLOW, SLOW, netem(), "doubled_delay", "both"),
        (PAPER, NOTHING, netem(), "one_direction", "downlink"),
        (NOTHING, PAPER, netem(restored=1), "no_qdisc", "uplink"),
        (NOTHING, NOTHING, ShaperFacts("none", interface="eth0"), "no_qdisc", "both"),
        (
            NOTHING,
            NOTHING,
            ShaperFacts("none", "this kernel has no sch_netem"),
            "no_sch_netem",
            "both",
        ),
        (NOTHING, NOTHING, netem(sent=3000, passed=3), "bypassed", "both"),
        (DEAF, DEAF, ShaperFacts(), "nothing_arrives", "both"),
    ],
)
def test_a_fault_is_named_with_its_direction_and_by_what_the_machine_reports(
    up, down, known, code, way
):
    found = find_causes(verify(PAPER, up, down, known))
    assert [(cause.code, cause.way) for cause in found] == [(code, way)]


@pytest.mark.parametrize(
    ("phase", "late", "verdict"),
    [(2.1, False, "ok"), (1.95, False, "ok"), (6.0, False, "off"), (6.0, True, "told")],
)
def test_probes_are_in_the_slots_of_the_radio_unless_the_machine_is_late(phase, late, verdict):
    """The relay takes the probes 0.1 ms after they are sent: at 1.95 ms behind the slot at 2 ms."""
    radio = Radio(phase_ms=1.95 if phase == 1.95 else 2.1)
    profile, real = (
        DirectionProfile(radio=replace(radio, phase_ms=at)) for at in (radio.phase_ms, phase)
    )
    plan = plan_probes(profile, Flow(1, True, PROBE, 100))
    relayed = replace(plan, profile=real).draw(plan.sent + 1e-4)
    measured = replace(relayed, sent=plan.sent, delays=relayed.delays + 1.5e-4)
    rows = plan.judge(measured)
    (row,) = plan.judge_phase(measured, late=late)
    assert row.verdict == verdict
    assert (doubts(rows) == []) == (phase != 6.0)
    (cause, *_) = find_causes({"uplink": Findings([row], ShaperFacts())}) or [None]
    assert (cause is not None and cause.code == "wrong_phase") == (verdict == "off")


def test_a_quantity_is_off_only_after_two_measurements():
    good, slow, lossy = (
        rows_of(PAPER, changed(PAPER, **values))
        for values in ({}, {"delay": 0.09}, {"delay": 0.09, "loss": 0.5})
    )
    assert verdict_of(look_twice(slow, good)) == verdict_of(look_twice(good, slow)) == "ok"
    assert doubts(look_twice(slow, lossy)) == [("mean", "off")]
