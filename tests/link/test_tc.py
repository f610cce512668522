"""A profile in tc's words, its tables, what is refused by name, and tc's errors in one sentence."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from cloudrc.assembly import link_profile
from cloudrc.config.load import load_profile
from cloudrc.config.shipped import names
from cloudrc.errors import BadInputError
from cloudrc.link.draws import Purpose, shape, stream_key
from cloudrc.link.netem import (
    ENTRIES,
    STRETCH,
    Answer,
    check,
    distribution_name,
    explain,
    limit,
    may_shape,
    notes,
    options,
    stretch,
    table,
    write_measured,
    write_tables,
)
from cloudrc.link.profile import Blackout, Change, DirectionProfile, GilbertElliott, Timeline, Trace

EVERYTHING = DirectionProfile(
    0.045, 0.0255, "normal", 0.25, loss=0.015, duplicate=0.02, reorder=0.1, corrupt=0.005
)
TIMED = DirectionProfile(
    0.02,
    duplicate=0.1,
    changes=(Change(1.0, delay=0.1, loss=0.5),),
    blackouts=(Blackout(2.0, 0.3),),
)


def text(profile: DirectionProfile, at: float = 0.0) -> str:
    check(profile)
    return " ".join(options(profile, Timeline(profile).at(round(at * 1e9)), limit(profile)))


@pytest.mark.parametrize(
    ("profile", "at", "words"),
    [
        (
            DirectionProfile(),
            0.0,
            "limit 10000 delay 0.000us loss random 0% duplicate 0% corrupt 0% rate 0bit",
        ),
        (
            EVERYTHING,
            0.0,
            "limit 10000 delay 45000.000us 25500.000us 25% distribution normal loss random 1.5% "
            "duplicate 2% corrupt 0.5% reorder 10% rate 0bit",
        ),
        (
            DirectionProfile(0.045, 0.002, "pareto"),
            0.0,
            "delay 45000.000us 8000.000us 0% distribution pareto",
        ),
        (DirectionProfile(loss=GilbertElliott(0.01, 0.1, 0.6, 0.005)), 0.0, "gemodel 1% 10% 60% 0"),
        # 100 + 0.3 s * 2 Mbit/s / (8 * 116 bit)
        (DirectionProfile(0.3, rate=2e6, queue_packets=100), 0.0, "limit 747 "),
        (DirectionProfile(0.3, rate=2e6, queue_packets=100), 0.0, "rate 2000000bit -14"),
        (DirectionProfile(0.04, 0.03, reorder=0.2, keep_order=True), 0.0, "% rate 100gbit"),
        (DirectionProfile(reorder=0.2), 0.0, "corrupt 0% rate"),  # without a delay tc refuses it
        (TIMED, 0.99, "delay 20000.000us loss random 0% duplicate 10%"),
        (TIMED, 1.0, "delay 100000.000us loss random 50% duplicate 10%"),
        (TIMED, 2.1, "delay 100000.000us loss random 100% duplicate 0%"),  # no copy arrives
        (TIMED, 2.3, "delay 100000.000us loss random 50% duplicate 10%"),
    ],
)
def test_a_profile_is_put_into_tcs_words(profile: DirectionProfile, at: float, words: str) -> None:
    assert words in text(profile, at)


BURSTS = GilbertElliott(0.1, 0.5, delay_bad=0.04)


@pytest.mark.parametrize(
    ("profile", "key"),
    [
        (DirectionProfile(300.0), "delay_ms above 274000"),
        (DirectionProfile(trace=Trace((0.0, 9.0), (0.1, 300.0))), "here 300000 ms"),
        (DirectionProfile(loss=BURSTS), "loss.delay_bad_ms"),
        (DirectionProfile(changes=(Change(1.0, loss=BURSTS),)), "loss.delay_bad_ms"),
        (DirectionProfile(jitter=0.01, rate=1e6), "without keep_order"),
        (DirectionProfile(rate=1e6, changes=(Change(1.0, jitter=0.1),)), "without keep_order"),
        (DirectionProfile(blackouts=(Blackout(1.0, 0.004),)), "here 4 ms at 1 s"),
    ],
)
def test_what_netem_cannot_do_is_refused_by_name(profile: DirectionProfile, key: str) -> None:
    with pytest.raises(BadInputError, match=r"netem cannot do .*; set link\.mode=relay") as refused:
        check(profile)
    assert key in str(refused.value)


@pytest.mark.parametrize("name", names("profile"))
def test_only_lossy_of_the_shipped_profiles_needs_the_relay(name: str) -> None:
    profile = link_profile(load_profile(name).downlink)
    if name == "lossy":
        with pytest.raises(BadInputError, match="delay_bad_ms"):
            check(profile)
    else:
        assert text(profile)


def test_what_netem_does_differently_is_said() -> None:
    profile = DirectionProfile(0.1, 0.01, correlation=0.3)
    assert notes(profile) == ["netem realises next to nothing of correlation 0.3"]
    assert notes(replace(profile, correlation=0.0)) == []
    assert "seen as loss" in notes(DirectionProfile(corrupt=0.01))[0]
    trace = Trace((0.0, 0.1, 0.101, 0.102), (0.1, 0.2, 0.3, 0.4))
    assert notes(DirectionProfile(trace=trace)) == [
        "netem is stepped every 5 ms at most: 2 of 4 steps of the time line come sooner, and some "
        "are passed over"
    ]


def test_the_limit_has_room_for_all_that_is_under_way() -> None:
    fast = DirectionProfile(delay=0.01, rate=2e6, queue_packets=100)
    assert limit(replace(fast, changes=(Change(1.0, delay=0.3),))) == 747
    assert limit(replace(fast, trace=Trace((0.0, 1.0), (0.3, 0.01)))) == 747
    assert limit(replace(fast, changes=(Change(1.0, delay=0.3),), rate=None)) == 10_000
    slow = DirectionProfile(delay=0.5, rate=1e5, queue_packets=5)
    assert limit(slow) >= 5 + 50  # 100 commands a second
    late = replace(slow, delay=0.1, jitter=0.1, distribution="pareto", keep_order=True)
    assert limit(late) >= 5 + 100 * (0.1 + 0.1 * 12.1)
    later = DirectionProfile(delay=0.04, queue_packets=20, changes=(Change(10.0, rate=5e4),))
    assert 20 + 100 * 0.04 <= limit(later) <= 20 + 1000 * 0.04


def test_a_measured_distribution_becomes_a_table(tmp_path: Path) -> None:
    drawn = np.random.default_rng(1).exponential(size=3000)
    values = tuple(np.sort((drawn - drawn.mean()) / drawn.std()).tolist())
    profile = DirectionProfile(0.04, 0.002, distribution="table", table=values)
    write_measured(tmp_path, profile)
    name, jitter = distribution_name(profile), 2000 * stretch(profile)
    assert f"delay 40000.000us {jitter}.000us 0% distribution {name}" in text(profile)
    _, *rows = (tmp_path / f"{name}.dist").read_text().splitlines()
    entries = np.array([int(word) for row in rows for word in row.split()])
    assert len(entries) == ENTRIES
    assert np.abs(entries).max() < 2**15
    shares = np.linspace(0.01, 0.99, 50)
    assert np.quantile(entries * stretch(profile) / 8192, shares) == pytest.approx(
        np.quantile(values, shares), abs=0.01
    )
    write_measured(tmp_path, replace(profile, distribution="normal"))
    assert [file.name for file in tmp_path.iterdir()] == [f"{name}.dist"]


@pytest.mark.parametrize("distribution", sorted(STRETCH))
def test_tables_are_the_models_distributions(distribution: str, tmp_path: Path) -> None:
    write_tables(tmp_path)
    first, *rows = (tmp_path / f"{distribution}.dist").read_text().splitlines()
    entries = np.array(table(distribution))
    assert first.startswith("#")
    assert [int(row) for row in rows] == entries.tolist()
    assert len(entries) == ENTRIES <= 16_384
    assert np.abs(entries).max() < 2**15
    profile = DirectionProfile(jitter=1.0, distribution=distribution)  # type: ignore[arg-type]
    key = stream_key(1, True, 1, 3)
    drawn = np.concatenate([shape(key, Purpose.DELAY, block, profile) for block in range(80)])
    unit = STRETCH[distribution] / 8192
    deviation = 3**-0.5 if distribution == "uniform" else 1.0
    assert entries.mean() * unit == pytest.approx(0.0, abs=0.001)
    assert entries.std() * unit == pytest.approx(deviation, rel=1e-3)
    shares = np.linspace(0.02, 0.9, 25)
    assert np.quantile(entries * unit, shares) == pytest.approx(
        np.quantile(drawn, shares), abs=0.06
    )


@pytest.mark.parametrize(
    ("answer", "words"),
    [
        (Answer(127, "", ""), "no program tc (package iproute2)"),
        (Answer(2, "", "RTNETLINK answers: Operation not permitted\n"), "NET_ADMIN and uid 0"),
        (Answer(2, "", "RTNETLINK answers: No such file or directory"), "has no sch_netem;"),
        (Answer(1, "", 'Illegal "latency"\n'), "'tc qdisc add netem' failed: Illegal \"latency\""),
        (Answer(3, "", ""), "exit code 3"),
    ],
)
def test_an_error_of_tc_becomes_one_sentence(answer: Answer, words: str) -> None:
    said = str(explain("tc", ("qdisc", "add", "netem"), answer))
    assert words in said
    assert "link.mode=relay" in said
    assert "\n" not in said


@pytest.mark.parametrize(
    ("uid", "capabilities", "may"),
    [
        ("0\t0\t0\t0", "000001ffffffffff", True),
        ("0\t0\t0\t0", "0000000000001000", True),
        ("0\t0\t0\t0", "00000000a80425fb", False),  # what a container has by default
        ("10001\t10001\t10001\t10001", "0000000000001000", False),
    ],
)
def test_root_with_the_capability_may_shape(uid: str, capabilities: str, may: bool) -> None:
    status = f"Name:\tpython\nUid:\t{uid}\nCapPrm:\t0\nCapEff:\t{capabilities}\n"
    assert may_shape(status) is may
    assert not may_shape("")
