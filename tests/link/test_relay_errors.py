"""What a relay knows of its own lateness, and how far ahead it wakes: pure, no clock."""

from __future__ import annotations

import numpy as np
import pytest

from cloudrc.exposition.table import LINK_OUTCOMES, RELEASE_PERCENTILES
from cloudrc.link.lateness import (
    FIRST_LEAD_MAX_NS,
    FIRST_SHARE_MAX,
    LEAD_MAX_NS,
    QUANTILES,
    SHARE_MAX,
    Lead,
    Recent,
    ReleaseErrors,
    in_ns,
)
from cloudrc.link.model import LinkDirection
from cloudrc.link.profile import DirectionProfile
from cloudrc.link.relay import Lane, Side, bind_loopback
from cloudrc.link.relay_io import AGE_MAX_NS, Stamps, instant_ns

MS, SECOND = 1_000_000, 1_000_000_000
MOST_NS = {False: LEAD_MAX_NS, True: FIRST_LEAD_MAX_NS}


def stamp(wall_ns: int) -> tuple[int, int, bytes]:
    seconds, rest = divmod(wall_ns, SECOND)
    return 1, 35, seconds.to_bytes(8, "little") + rest.to_bytes(8, "little")


def told(count: int) -> tuple[int, int, bytes]:
    return 1, 40, count.to_bytes(4, "little")


@pytest.mark.parametrize("scale", [20e3, 2e6, 200e6])
def test_percentiles_are_those_of_the_sample_to_one_bucket(scale: float) -> None:
    sample = np.random.default_rng(1).exponential(scale, 20_000).astype(int)
    errors = ReleaseErrors()
    for error_ns in sample.tolist():
        errors.observe(error_ns)
    for (name, said), share in zip(errors.quantiles().items(), (0.5, 0.99, 0.999), strict=True):
        true = np.quantile(sample, share, method="inverted_cdf")
        width = 1 << (10 if true < 1 << 20 else 16 if true < 1 << 26 else 26)
        assert true <= said * 1e9 <= true + width, name


def test_nothing_is_said_before_the_first() -> None:
    assert ReleaseErrors().quantiles() == {}


def test_it_is_told_in_whole_numbers_for_the_report() -> None:
    errors = ReleaseErrors()
    assert in_ns(errors) == {}
    for error_ns in (-1, 9_000, 9_000, 300_000):
        errors.observe(error_ns)
    told = in_ns(errors)
    assert (told["released"], told["released_early"]) == (4, 1)
    assert 9_000 <= told["release_error_p50_ns"] < 10_300
    assert 300_000 <= told["release_error_p99_ns"] == told["release_error_p999_ns"] < 301_100


def test_an_early_one_is_counted() -> None:
    errors = ReleaseErrors()
    errors.observe(-1)
    assert Recent().counts(errors)["released_early"] == 1
    assert errors.quantiles()["release_error_p999"] < 2e-6


def test_two_lanes_are_added_up() -> None:
    parts = ReleaseErrors(), ReleaseErrors()
    for part, late_ns in zip(parts, (5_000, 400 * MS), strict=True):
        part.observe(late_ns)
    both = ReleaseErrors.together(parts)
    assert both.count == 2
    assert both.quantiles()["release_error_p50"] < 6e-6
    assert 0.4 < both.quantiles()["release_error_p99"] < 0.47


def test_of_late_are_the_last_ten_calls() -> None:
    errors, recent, said = ReleaseErrors(), Recent(), []
    for second in range(14):
        errors = ReleaseErrors.together((errors,))
        errors.observe(9 * MS if second == 2 else 10_000)
        said.append(recent.counts(errors)["release_error_p999_ns"])
    assert [late_ns > 8 * MS for late_ns in said] == [2 <= n < 12 for n in range(14)]


def test_a_lateness_beyond_all_buckets_is_in_the_last() -> None:
    errors = ReleaseErrors()
    errors.observe(10**15)
    assert errors.quantiles()["release_error_p50"] > 60.0


def test_metrics_and_relay_agree_on_names() -> None:
    named = {name: float(label) / 100.0 for label, name in RELEASE_PERCENTILES.items()}
    assert named == pytest.approx(QUANTILES)
    direction = LinkDirection(DirectionProfile(), 1, True)
    with bind_loopback() as one, bind_loopback() as other:
        lane = Lane(Side(one), Side(other), direction, lambda data: (3, 1, 0))
        assert set(lane.counts()) == set(LINK_OUTCOMES)


def test_a_stamp_becomes_an_age() -> None:
    stamps, now_ns = Stamps(), 5 * SECOND
    wall_ns = 1_700_000_000 * SECOND
    offset_ns = now_ns - wall_ns
    for age_ns, counted_ns in ((7_000, 7_000), (0, 0), (-3_000, 0), (80 * MS, AGE_MAX_NS)):
        came_ns = stamps.wall_ns([stamp(wall_ns - age_ns)])
        assert now_ns - instant_ns(came_ns, offset_ns, now_ns) == counted_ns


def test_without_a_valid_stamp_arrival_is_the_time_of_reading() -> None:
    assert Stamps().wall_ns([]) is None
    assert instant_ns(None, 0, 9 * SECOND) == 9 * SECOND
    assert instant_ns(9 * SECOND - MS, None, 9 * SECOND) == 9 * SECOND


def test_a_set_wall_clock_is_noticed_once(monkeypatch: pytest.MonkeyPatch) -> None:
    stamps, shift = Stamps(), 0
    monkeypatch.setattr("time.monotonic_ns", lambda: 5 * SECOND)
    monkeypatch.setattr("time.time_ns", lambda: 1_700_000_000 * SECOND + shift)
    usual = stamps.look_at_clocks()
    assert usual == stamps.look_at_clocks() == 5 * SECOND - 1_700_000_000 * SECOND
    shift = -3 * SECOND
    assert stamps.look_at_clocks() is None
    assert stamps.look_at_clocks() == 5 * SECOND - 1_700_000_000 * SECOND + 3 * SECOND


def test_what_the_kernel_dropped_is_counted_over_its_overflow() -> None:
    stamps = Stamps()
    for total in (5, 5, 9):
        stamps.wall_ns([told(total), stamp(0)])
    assert stamps.dropped == 9
    stamps.wall_ns([told(2**32 - 1)])
    stamps.wall_ns([told(3)])
    assert stamps.dropped == 2**32 + 3


@pytest.mark.parametrize(
    ("usual_ns", "first"), [(8_000, False), (25_000, False), (48_000, False), (110_000, True)]
)
def test_the_lead_covers_most_wakes(usual_ns: int, first: bool) -> None:
    lead, generator = Lead(first=first), np.random.default_rng(2)
    late = generator.normal(usual_ns, 0.1 * usual_ns, 20_000).tolist()
    for late_ns in late:
        lead.woke(round(late_ns))
    kept = np.mean(np.array(late[-5000:]) <= lead.ahead_ns())
    assert kept > 0.85
    assert lead.ahead_ns() < min(1.6 * usual_ns + 5_000, MOST_NS[first] + 1)


@pytest.mark.parametrize(("first", "share"), [(False, SHARE_MAX), (True, FIRST_SHARE_MAX)])
def test_looking_at_the_clock_takes_a_bounded_share(first: bool, share: float) -> None:
    lead, now_ns, spent_ns = Lead(first=first), SECOND, 0
    for _ in range(100_000):
        lead.woke(1_000 * MS)  # a machine so busy that the lead is at its bound
        ahead_ns = lead.ahead_ns()
        if ahead_ns:
            lead.looked(now_ns, now_ns + ahead_ns)
        else:
            lead.rests(now_ns)
        spent_ns += ahead_ns
        now_ns += 200_000
    assert spent_ns / (now_ns - SECOND) == pytest.approx(share, rel=0.1)
    assert share <= (0.10 if first else 0.05)
