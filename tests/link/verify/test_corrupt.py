"""Damage is verified like anything else: seen in probes, and as a loss where it is refused."""

from __future__ import annotations

from dataclasses import replace

import pytest

from cloudrc.cli.link_verify_run import PROBE, TRAIN, Probes
from cloudrc.cli.link_verify_text import notes
from cloudrc.link.profile import Change, DirectionProfile, GilbertElliott, Trace, mean_loss
from cloudrc.link.verify.causes import find_causes
from cloudrc.link.verify.expect import JITTER_SHARES, refusing
from cloudrc.link.verify.plan import make_plan
from tests.link.verify.conftest import Asked, probe

DAMAGING = DirectionProfile(0.02, 0.01, corrupt=0.1)


@pytest.mark.parametrize("kind", [PROBE, TRAIN])
@pytest.mark.parametrize("way", ["uplink", "downlink"])
def test_any_flipped_bit_is_seen_and_the_probe_identified(kind: int, way: str) -> None:
    probes = Probes({"uplink": 187, "downlink": 72})
    whole = probes.write(way, kind, 77)
    assert probes.read(whole) == (kind, 1, 77)
    assert probes.damaged == {"uplink": set(), "downlink": set()}
    for bit in range(8 * min(len(whole), 187)):
        damaged = bytearray(whole)
        damaged[bit >> 3] ^= 1 << (bit & 7)
        assert probes.read(bytes(damaged)) == (kind, 1, 77)
        assert probes.damaged[way] == ({77} if kind == PROBE else set())
        probes.damaged[way].clear()


def test_what_is_too_short_is_no_probe() -> None:
    with pytest.raises(ValueError, match="malformed"):
        Probes({"uplink": 187, "downlink": 72}).read(b"\0\1")


def test_only_the_requested_corruption_is_believed() -> None:
    asked = Asked.of(DAMAGING)
    rows = {row.name: row for row in probe(asked, DAMAGING).rows}
    assert {row.verdict for row in rows.values()} == {"ok"}
    assert rows["corrupted"].measured == pytest.approx(0.1, abs=0.02)
    for real in (replace(DAMAGING, corrupt=0.0), replace(DAMAGING, corrupt=0.2)):
        causes = find_causes({"uplink": probe(asked, real)})
        assert [cause.code for cause in causes] == ["wrong_corruption"]


def test_who_refuses_what_is_damaged_meets_a_loss() -> None:
    bursts = GilbertElliott(0.01, 0.2, 0.5, 0.1)
    profile = DirectionProfile(
        0.02,
        loss=bursts,
        corrupt=0.2,
        changes=(Change(1.0, loss=0.5), Change(2.0, delay=0.1)),
        trace=Trace((0.0,), (0.02,), (0.25,)),
    )
    found = refusing(profile)
    assert found.corrupt == 0.0
    assert mean_loss(found.loss) == pytest.approx(1.0 - 0.8 * (1.0 - mean_loss(bursts)))
    assert [change.loss for change in found.changes] == [pytest.approx(0.6), None]
    assert found.trace is not None
    assert found.trace.losses == (pytest.approx(0.4),)
    assert refusing(replace(profile, corrupt=0.0)) == replace(profile, corrupt=0.0)


def test_a_datagram_that_the_machine_loses_is_not_the_links() -> None:
    """Of an ideal link one in a thousand may go missing; twenty may not."""
    nothing = DirectionProfile()
    asked = Asked.of(nothing)
    for loss, verdict in ((0.001, "ok"), (0.02, "off")):
        rows = {row.name: row for row in probe(asked, replace(nothing, loss=loss)).rows}
        assert rows["loss"].verdict == verdict
        assert rows["loss"].high * asked.plan.schedule.count >= 5


BURSTS = GilbertElliott(0.01, 0.1, 0.5, 0.0, 0.3)
HARD = {
    "overtaken": DirectionProfile(0.2, 0.005, reorder=0.5),
    "in order": DirectionProfile(0.07, 0.04, keep_order=True),
    "in slow bursts": DirectionProfile(0.1, 0.005, loss=BURSTS),
    "alike": DirectionProfile(0.06, 0.01, "normal", correlation=0.9),
}


@pytest.mark.full
@pytest.mark.parametrize("name", HARD)
def test_jitter_is_judged_at_a_tenth_however_it_hides(name: str) -> None:
    profile = HARD[name]
    asked = Asked.of(profile)
    assert asked.plan.enough
    assert asked.plan.expects.share == JITTER_SHARES[0]
    assert {row.verdict for row in probe(asked, profile).rows} == {"ok"}
    for factor in (0.0, 0.9, 1.1, 10.0):
        off = replace(profile, jitter=factor * profile.jitter)
        assert "off" in {row.verdict for row in probe(asked, off, overhead_ns=0).rows}, factor


def test_what_is_judged_more_loosely_than_usual_is_said() -> None:
    plan = make_plan(DirectionProfile(0.02, 0.01), 200)
    assert list(notes("uplink", plan, None)) == []
    loose = replace(plan, expects=replace(plan.expects, share=0.25))
    assert "within 25%" in "".join(notes("uplink", loose, None))
    little = make_plan(DirectionProfile(0.02, 0.001), 200)
    assert "jitter, judged within 0.5 ms only" in "".join(notes("uplink", little, None))
    assert list(notes("uplink", make_plan(DirectionProfile(0.02), 200), None)) == []
    never = replace(plan, expects=replace(plan.expects, share=0.0))
    assert "jitter NOT JUDGED" in "".join(notes("uplink", never, None))
