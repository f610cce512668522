"""What netem is asked for: a profile in tc's words, its tables, and what is refused by name."""

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
from cloudrc.link.profile import Blackout, Change, DirectionProfile, GilbertElliott, Timeline, Trace
from cloudrc.link.tc import (
    ENTRIES,
    STRETCH,
    check,
    distribution_name,
    limit,
    notes,
    options,
    stretch,
    table,
    write_measured,
    write_tables,
)


def text(profile: DirectionProfile, at: float = 0.0) -> str:
    check(profile)
    return " ".join(options(profile, Timeline(profile).at(round(at * 1e9)), limit(profile)))


def test_nothing_asked_takes_everything_back() -> None:
    assert text(DirectionProfile()) == (
        "limit 10000 delay 0.000us loss random 0% duplicate 0% corrupt 0% rate 0bit"
    )


def test_everything_that_netem_has_is_named() -> None:
    profile = DirectionProfile(
        delay=0.045, jitter=0.0255, distribution="normal", correlation=0.25, loss=0.015,
        duplicate=0.02, reorder=0.1, corrupt=0.005,
    )  # fmt: skip
    assert text(profile) == (
        "limit 10000 delay 45000.000us 25500.000us 25% distribution normal "
        "loss random 1.5% duplicate 2% corrupt 0.5% reorder 10% rate 0bit"
    )


def test_a_pareto_jitter_is_stretched_as_its_table_is_squeezed() -> None:
    words = text(DirectionProfile(delay=0.045, jitter=0.002, distribution="pareto"))
    assert "delay 45000.000us 8000.000us 0% distribution pareto" in words


def test_bursts_are_tcs_gemodel() -> None:
    profile = DirectionProfile(loss=GilbertElliott(0.01, 0.1, 0.6, 0.005))
    assert "loss gemodel 1% 10% 60% 0.5%" in text(profile)


def test_the_limit_holds_the_queue_and_what_is_under_way() -> None:
    profile = DirectionProfile(delay=0.3, rate=2e6, queue_packets=100)
    assert text(profile).startswith("limit 747 ")  # 100 + 0.3 s * 2 Mbit/s / (8 * 116 bit)
    assert text(profile).endswith("rate 2000000bit -14")


def test_a_rate_keeps_the_order_and_reorder_is_undone() -> None:
    words = text(DirectionProfile(delay=0.04, jitter=0.03, reorder=0.2, keep_order=True))
    assert words.endswith("rate 100gbit")
    assert "reorder" not in words


def test_reorder_without_a_delay_is_left_out_since_tc_refuses_it() -> None:
    assert "reorder" not in text(DirectionProfile(reorder=0.2))


def test_in_a_blackout_no_copy_of_what_is_lost_arrives() -> None:
    profile = DirectionProfile(duplicate=0.1, blackouts=(Blackout(2.0, 0.3),))
    before, within = (
        options(profile, Timeline(profile).at(round(at * 1e9)), 10) for at in (1.0, 2.1)
    )
    assert before[before.index("duplicate") + 1] == "10%"
    assert within[within.index("duplicate") + 1] == "0%"


def test_changes_and_blackouts_are_steps() -> None:
    profile = DirectionProfile(
        delay=0.02, changes=(Change(1.0, delay=0.1, loss=0.5),), blackouts=(Blackout(2.0, 0.3),)
    )
    assert "delay 20000.000us loss random 0%" in text(profile, 0.99)
    assert "delay 100000.000us loss random 50%" in text(profile, 1.0)
    assert "delay 100000.000us loss random 100%" in text(profile, 2.1)
    assert "delay 100000.000us loss random 50%" in text(profile, 2.3)


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
def test_what_netem_cannot_do_is_refused_by_its_name(profile: DirectionProfile, key: str) -> None:
    with pytest.raises(BadInputError, match=r"netem cannot do .*; set link\.mode=relay") as refused:
        check(profile)
    assert key in str(refused.value)


def test_what_netem_does_otherwise_is_said() -> None:
    profile = DirectionProfile(0.1, 0.01, correlation=0.3)
    assert notes(profile) == ["netem realises next to nothing of correlation 0.3"]
    assert notes(replace(profile, correlation=0.0)) == []
    assert "seen as loss" in notes(DirectionProfile(corrupt=0.01))[0]
    trace = Trace((0.0, 0.1, 0.101, 0.102), (0.1, 0.2, 0.3, 0.4))
    assert notes(DirectionProfile(trace=trace)) == [
        "netem is stepped every 5 ms at most: 2 of 4 steps of the time line come sooner, and some "
        "are passed over"
    ]


def test_the_limit_is_that_of_the_longest_delay_on_the_time_line() -> None:
    profile = DirectionProfile(delay=0.01, rate=2e6, queue_packets=100)
    assert limit(replace(profile, changes=(Change(1.0, delay=0.3),))) == 747
    assert limit(replace(profile, trace=Trace((0.0, 1.0), (0.3, 0.01)))) == 747
    assert limit(replace(profile, changes=(Change(1.0, delay=0.3),), rate=None)) == 10_000


def test_the_limit_has_room_for_commands_in_the_longest_jitter() -> None:
    slow = DirectionProfile(delay=0.5, rate=1e5, queue_packets=5)
    assert limit(slow) >= 5 + 50  # 100 commands a second
    late = replace(slow, delay=0.1, jitter=0.1, distribution="pareto", keep_order=True)
    assert limit(late) >= 5 + 100 * (0.1 + 0.1 * 12.1)


def test_a_rate_that_begins_later_has_its_own_queue() -> None:
    profile = DirectionProfile(delay=0.04, queue_packets=20, changes=(Change(10.0, rate=5e4),))
    assert 20 + 100 * 0.04 <= limit(profile) <= 20 + 1000 * 0.04


def test_a_measured_distribution_becomes_a_table_of_its_own(tmp_path: Path) -> None:
    drawn = np.random.default_rng(1).exponential(size=3000)
    values = tuple(np.sort((drawn - drawn.mean()) / drawn.std()).tolist())
    profile = DirectionProfile(0.04, 0.002, distribution="table", table=values)
    write_measured(tmp_path, profile)
    name = distribution_name(profile)
    jitter = 2000 * stretch(profile)
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


@pytest.mark.parametrize("name", names("profile"))
def test_of_the_shipped_profiles_only_lossy_needs_the_relay(name: str) -> None:
    profile = link_profile(load_profile(name).downlink)
    if name == "lossy":
        with pytest.raises(BadInputError, match="delay_bad_ms"):
            check(profile)
    else:
        assert text(profile)


@pytest.mark.parametrize("distribution", sorted(STRETCH))
def test_tables_are_the_models_distributions(distribution: str) -> None:
    entries = np.array(table(distribution))
    assert len(entries) == ENTRIES <= 16_384
    assert np.abs(entries).max() < 2**15
    profile = DirectionProfile(jitter=1.0, distribution=distribution)  # type: ignore[arg-type]
    key = stream_key(1, True, 1, 3)
    drawn = np.concatenate([shape(key, Purpose.DELAY, block, profile) for block in range(80)])
    unit = STRETCH[distribution] / 8192
    assert entries.mean() * unit == pytest.approx(0.0, abs=0.001)
    assert entries.std() * unit == pytest.approx(
        3**-0.5 if distribution == "uniform" else 1.0, rel=1e-3
    )
    shares = np.linspace(0.02, 0.9, 25)
    assert np.quantile(entries * unit, shares) == pytest.approx(
        np.quantile(drawn, shares), abs=0.06
    )


def test_tables_are_written_as_tc_reads_them(tmp_path: Path) -> None:
    write_tables(tmp_path)
    assert sorted(file.name for file in tmp_path.iterdir()) == [
        "normal.dist", "pareto.dist", "uniform.dist",
    ]  # fmt: skip
    first, *rows = (tmp_path / "normal.dist").read_text().splitlines()
    assert first.startswith("#")
    assert [int(word) for row in rows for word in row.split()] == table("normal")
