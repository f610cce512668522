"""Which links are believed, which are not and why: whole links in virtual time."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from cloudrc.assembly import link_profile
from cloudrc.config.load import load_profile
from cloudrc.config.shipped import names
from cloudrc.link.profile import DirectionProfile
from cloudrc.link.verify.causes import Cause, Evidence, Findings, find_causes
from tests.link.verify.conftest import Asked, probe, random_profile

PAPER = link_profile(load_profile("paper-p2").uplink)
LOSING = DirectionProfile(0.045, 0.025, loss=0.05)
NARROW = DirectionProfile(0.020, 0.002, rate=2e6, queue_packets=200, keep_order=True)
NORMAL, HEAVY = replace(PAPER, distribution="normal"), replace(PAPER, loss=0.2)
NOTHING = DirectionProfile()
QUICK = ("ideal", "paper-p1", "paper-p2")


@cache
def asked(profile: DirectionProfile) -> Asked:
    return Asked.of(profile)


def doubts(findings: Findings) -> list[str]:
    """Rows that keep a link from being believed."""
    rows = [row for row in findings.rows if (row.name, row.verdict) != ("rate", "open")]
    return [f"{row.name} {row.verdict}" for row in rows if row.verdict != "ok"]


def verify(
    profile: DirectionProfile, up: DirectionProfile, down: DirectionProfile, evidence: Evidence
) -> list[Cause]:
    """Ask for a profile both ways, meet another one in each, and explain it."""
    plan = asked(profile)
    ways = {"uplink": (up, 1), "downlink": (down, 2)}
    found = {way: probe(plan, real, seed, evidence=evidence) for way, (real, seed) in ways.items()}
    return find_causes(found)


@pytest.mark.promise("verify-tells-the-link")
@pytest.mark.parametrize("name", QUICK)
def test_a_true_link_is_believed(name: str) -> None:
    for way in ("uplink", "downlink"):
        profile = link_profile(getattr(load_profile(name), way))
        assert [doubts(probe(asked(profile), profile, seed)) for seed in range(10)] == [[]] * 10


@pytest.mark.full
def test_200_true_links_of_200_are_believed(figure: Callable[..., None]) -> None:
    shipped = [link_profile(load_profile(name).uplink) for name in names("profile")]
    rng = np.random.default_rng(1)
    links = [(profile, seed) for profile in shipped for seed in range(12)]
    links += [(random_profile(rng), 1) for _ in range(200 - len(links))]
    assert len(links) == 200
    found = {}
    for profile, seed in links:
        plan = asked(profile)
        assert plan.plan.enough, f"{profile} needs {plan.plan.needs} probes"
        if wrong := doubts(probe(plan, profile, seed)):
            found[profile, seed] = wrong
    figure("true links: not believed", len(found), "==", 0, count=len(links))
    assert found == {}


def told(**facts: object) -> Evidence:
    return Evidence(**{"shaper": "netem", "layers": 1, **facts})  # type: ignore[arg-type]


# What is asked, what is there each way, what the shaper tells of itself.
FAULTS: dict[str, tuple[DirectionProfile, DirectionProfile, DirectionProfile, Evidence]] = {
    "no_qdisc": (PAPER, NOTHING, NOTHING, Evidence("none", interface="eth0")),
    "wrong_interface": (
        PAPER,
        NOTHING,
        NOTHING,
        Evidence("none", interface="eth0", elsewhere=("eth1",)),
    ),
    "doubled_delay": (PAPER, *[replace(PAPER, delay=0.090)] * 2, told(applied=PAPER)),
    "halved_delay": (PAPER, *[replace(PAPER, delay=0.0225, jitter=0.0125)] * 2, told()),
    "one_direction": (PAPER, PAPER, NOTHING, told()),
    "wrong_jitter": (PAPER, *[replace(PAPER, jitter=0.0225)] * 2, told(applied=PAPER)),
    "no_loss": (LOSING, *[replace(LOSING, loss=0.0)] * 2, told(applied=LOSING)),
    "more_loss": (LOSING, *[replace(LOSING, loss=0.15)] * 2, told(applied=LOSING)),
    "bypassed": (PAPER, NOTHING, NOTHING, told(applied=PAPER, sent=3000, passed=3)),
    "order_kept": (PAPER, *[replace(PAPER, keep_order=True)] * 2, told(applied=PAPER)),
    "rate_ignored": (NARROW, *[replace(NARROW, rate=None)] * 2, told(applied=NARROW)),
    "no_sch_netem": (PAPER, NOTHING, NOTHING, Evidence("none", why="this kernel has no sch_netem")),
    "shaped_twice": (PAPER, *[replace(PAPER, delay=0.090)] * 2, replace(told(), layers=2)),
    "order_broken": (NARROW, *[replace(NARROW, keep_order=False, jitter=0.015)] * 2, told()),
    "wrong_duplicates": (PAPER, *[replace(PAPER, duplicate=0.1)] * 2, told()),
}


@pytest.mark.promise("verify-tells-the-link")
@pytest.mark.parametrize("fault", FAULTS)
def test_a_fault_is_named(fault: str, figure: Callable[..., None]) -> None:
    causes = {cause.code for cause in verify(*FAULTS[fault])}
    figure("seeded faults of the link: not named", int(causes != {fault}), "==", 0)
    assert causes == {fault}


def test_a_relay_that_does_not_get_its_cpu_is_named() -> None:
    late = Evidence("relay", layers=1, applied=PAPER, late=0.039)
    found = {"uplink": probe(asked(PAPER), PAPER, 1, stall=0.04, evidence=late)}
    assert [cause.code for cause in find_causes(found)] == ["throttled"]
    deaf = replace(late, late=None, sent=3000, passed=2500, unread=500)
    found = {"uplink": found["uplink"]._replace(evidence=deaf)}
    assert "no time to read 500 of 3000" in find_causes(found)[0].text
    losing = probe(asked(PAPER), replace(PAPER, loss=0.3), 1, stall=0.04, evidence=deaf)
    codes = [cause.code for cause in find_causes({"uplink": losing})]
    assert codes == ["throttled", "more_loss"], "500 unread are not 900 lost"
    stopped = replace(late, late=None, throttled=0.4)
    found = {"uplink": found["uplink"]._replace(evidence=stopped)}
    assert "40%" in find_causes(found)[0].text


@pytest.mark.parametrize("fault", ["order_kept", "rate_ignored", "halved_delay", "no_loss"])
def test_cpu_starvation_hides_no_fault_that_it_cannot_cause(fault: str) -> None:
    """It adds delay, scatter and losses; it never makes a link quicker, or more orderly."""
    profile, real, _, evidence = FAULTS[fault]
    deaf = replace(evidence, shaper="relay", sent=2000, unread=99)
    codes = [cause.code for cause in find_causes({"uplink": probe(asked(profile), real, 1)})]
    assert codes == [fault]
    found = {"uplink": probe(asked(profile), real, 1, evidence=deaf)}
    assert [cause.code for cause in find_causes(found)] == ["throttled", fault]


def test_a_qdisc_that_was_put_back_is_not_told_as_one_direction() -> None:
    """For a while everything of one way went straight through."""
    back = told(applied=PAPER, restored=1)
    found = {
        "uplink": probe(asked(PAPER), NOTHING, 1, evidence=back),
        "downlink": probe(asked(PAPER), PAPER, 2, evidence=told(applied=PAPER)),
    }
    assert [(cause.code, cause.way) for cause in find_causes(found)] == [("no_qdisc", "uplink")]


def test_rare_throttling_hides_no_other_cause() -> None:
    evidence = told(applied=PAPER, throttled=0.02)
    found = {"uplink": probe(asked(PAPER), replace(PAPER, delay=0.090), 1, evidence=evidence)}
    assert [cause.code for cause in find_causes(found)] == ["doubled_delay"]


@pytest.mark.parametrize(
    ("profile", "off"),
    [
        (PAPER, replace(PAPER, delay=PAPER.delay * 1.05)),
        (PAPER, replace(PAPER, delay=PAPER.delay * 0.95)),
        (PAPER, replace(PAPER, jitter=PAPER.jitter * 1.1)),
        (PAPER, replace(PAPER, jitter=PAPER.jitter * 0.9)),
        (NORMAL, replace(NORMAL, jitter=NORMAL.jitter * 1.1)),
        (NORMAL, replace(NORMAL, jitter=NORMAL.jitter * 0.9)),
        (PAPER, replace(PAPER, loss=0.02)),
        (HEAVY, replace(HEAVY, loss=0.15)),
        (HEAVY, replace(HEAVY, loss=0.25)),
        (LOSING, replace(LOSING, loss=0.03)),
        (LOSING, replace(LOSING, loss=0.07)),
        (NARROW, replace(NARROW, rate=NARROW.rate and 1.25 * NARROW.rate)),
        (NARROW, replace(NARROW, rate=NARROW.rate and 0.75 * NARROW.rate)),
    ],
)
def test_a_link_that_is_off_by_its_margin_is_not_believed(
    profile: DirectionProfile, off: DirectionProfile
) -> None:
    told = Evidence("relay")
    believed = [
        seed
        for seed in range(15)
        if not doubts(probe(asked(profile), off, seed, evidence=told, overhead_ns=0))
    ]
    assert believed == []


def test_the_cause_says_whether_the_shaper_was_told_so() -> None:
    wrong = replace(PAPER, delay=0.090)
    (cause,) = [c for c in verify(PAPER, wrong, wrong, told(applied=wrong)) if c.way == "uplink"]
    assert cause.text.endswith("it was told so")
    assert "2.01 times" in cause.text


def test_both_directions_are_told_apart() -> None:
    losing = replace(PAPER, loss=0.2)
    assert [(c.code, c.way) for c in verify(PAPER, PAPER, losing, told())] == [
        ("more_loss", "downlink")
    ]
    assert verify(PAPER, PAPER, PAPER, told()) == []


def test_too_few_probes_decide_nothing() -> None:
    plan = asked(PAPER)
    few = Asked.of(PAPER, seconds=1.0)
    assert not few.plan.enough
    assert plan.plan.enough
    assert {row.verdict for row in probe(few, PAPER).rows} >= {"open"}
    far = probe(few, replace(PAPER, delay=0.090))
    assert far.rows[0].verdict == "off", "what is far off is told by a few"


def test_a_dead_link_is_off() -> None:
    found = probe(asked(PAPER), replace(PAPER, loss=1.0))
    rows = {row.name: row.verdict for row in found.rows}
    assert (rows["loss"], rows["mean"]) == ("off", "open"), "nothing arrived that had a delay"
    assert [cause.code for cause in find_causes({"uplink": found})] == ["nothing_arrives"]
