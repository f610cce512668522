"""An end records the link's state at first, at changes and at mission starts."""

from __future__ import annotations

import json
import math
import os
from dataclasses import asdict, replace
from math import nan
from pathlib import Path

import pytest

from cloudrc.drivers.feed import Feed, in_words
from cloudrc.drivers.process import LinkNotes
from cloudrc.link.relay import ReleaseErrors
from cloudrc.link.state import STATE_MAX, LinkState, publish, to_text
from cloudrc.messages import GuardState
from cloudrc.records import Counted, GuardChange, LinkChanged, Record, SessionOpened

MS = 1_000_000
STATE = LinkState(
    shaper="relay",
    reason="local mode",
    mode="relay",
    direction="downlink",
    profile={"uplink": {"delay_ms": 45.0}, "downlink": {"delay_ms": 20.0, "jitter_ms": 5.0}},
    since="2026-01-02T03:04:05+00:00",
    since_ns=100 * MS,
    asked={"delay": 0.02, "jitter": 0.005, "loss": 0.0, "rate": None},
)
SET = replace(
    STATE,
    since_ns=950 * MS,
    changes=1,
    change="a1",
    cause="downlink.delay_ms=120",
    asked={"delay": 0.12, "jitter": 0.005, "loss": 0.02, "rate": 2e6},
    origin_ns=600 * MS,
)


def tell(path: Path, state: LinkState) -> None:
    publish(path, to_text(state))


def test_a_change_is_recorded_once_and_again_at_a_mission_start(tmp_path: Path) -> None:
    path = tmp_path / "link.json"
    notes = LinkNotes(path, uplink=False)
    assert notes.after([], 0) == []
    tell(path, STATE)
    (first,) = notes.after([], 200 * MS)
    assert isinstance(first, LinkChanged)
    assert (first.stamp_ns, first.uplink, first.shaper, first.cause) == (
        200 * MS,
        False,
        "relay",
        "",
    )
    assert first.age == pytest.approx(0.1)
    assert math.isnan(first.time_line)
    assert math.isnan(first.rate)
    assert json.loads(first.conditions) == {"delay_ms": 20.0, "jitter_ms": 5.0}
    assert notes.after([], 400 * MS) == []
    tell(path, SET)
    (changed,) = notes.after([], 1000 * MS, 30 * MS)
    assert isinstance(changed, LinkChanged)
    assert (changed.stamp_ns, changed.cause) == (970 * MS, "downlink.delay_ms=120")
    assert (changed.age, changed.time_line) == pytest.approx((0.05, 0.4))
    assert (changed.delay, changed.loss, changed.rate) == (0.12, 0.02, 2e6)
    tracks = GuardChange(1010 * MS, GuardState.TRACK, "mission started")
    (again,) = notes.after([tracks], 1010 * MS)
    assert again == changed._replace(
        stamp_ns=1010 * MS, age=pytest.approx(0.06), time_line=pytest.approx(0.41)
    )


def test_the_file_is_looked_at_ten_times_a_second(tmp_path: Path) -> None:
    path = tmp_path / "link.json"
    tell(path, STATE)
    notes = LinkNotes(path, uplink=False)
    assert len(notes.after([], 200 * MS)) == 1
    tell(path, SET)
    seen = [at for at in range(201, 400) if notes.after([], at * MS)]
    assert seen == [300]


def test_a_refusal_or_a_broken_file_is_no_change(tmp_path: Path) -> None:
    path = tmp_path / "link.json"
    tell(path, STATE)
    notes = LinkNotes(path, uplink=False)
    notes.after([], 0)
    tell(path, replace(STATE, refused="b2", refusal="netem cannot"))
    assert notes.after([], 200 * MS) == []
    for at, text in ((400, "{"), (600, '{"shaper": "relay"}'), (800, "[]")):
        path.write_text(text)
        assert notes.after([], at * MS) == []
    tell(path, SET)
    assert len(notes.after([], 1000 * MS)) == 1


@pytest.mark.parametrize(
    "wrong",
    [
        {"asked": {"delay": "45 ms"}},
        {"asked": [1]},
        {"since_ns": "5"},
        {"since_ns": -(10**400)},
        {"origin_ns": "5"},
        {"profile": []},
        {"direction": {}},
        {"shaper": 5},
    ],
    ids=lambda wrong: next(iter(wrong)),
)
def test_a_state_of_which_nothing_can_be_noted_is_no_change(
    tmp_path: Path, wrong: dict[str, object]
) -> None:
    path = tmp_path / "link.json"
    tell(path, STATE)
    notes, began = LinkNotes(path, uplink=False), [SessionOpened(0, "cloud", 1, "")]
    (before,) = notes.after([], 200 * MS)
    path.write_text(json.dumps(asdict(SET) | wrong))
    (again,) = notes.after(began, 400 * MS)
    assert isinstance(before, LinkChanged)
    assert again == before._replace(
        stamp_ns=400 * MS, age=pytest.approx(0.3), time_line=pytest.approx(nan, nan_ok=True)
    )


def test_a_too_long_state_is_not_recorded_nor_the_last_one(tmp_path: Path) -> None:
    """A long time line is in force, so the last note no longer holds."""
    path = tmp_path / "link.json"
    tell(path, STATE)
    notes, began = LinkNotes(path, uplink=False), [SessionOpened(0, "cloud", 1, "")]
    assert len(notes.after([], 200 * MS)) == 1
    tell(path, replace(SET, reason="x" * STATE_MAX))
    assert notes.after(began, 400 * MS) == []
    tell(path, STATE)
    assert len(notes.after([], 600 * MS)) == 1


@pytest.mark.parametrize("text", ["[" * 100_000, '{"released": Infinity}', '{"released": [1]}'])
def test_nonsense_in_either_file_ends_nothing(tmp_path: Path, text: str) -> None:
    path = tmp_path / "link.json"
    for one in (path, path.with_suffix(".released")):
        one.write_text(text)
    assert LinkNotes(path, uplink=True).after([], 0) == []


def test_what_is_no_file_is_not_waited_for(tmp_path: Path) -> None:
    path = tmp_path / "link.json"
    for one in (path, path.with_suffix(".released")):
        os.mkfifo(one)
    assert LinkNotes(path, uplink=True).after([], 0) == []


def test_foreign_words_are_noted_in_one_line_that_can_be_written(tmp_path: Path) -> None:
    path = tmp_path / "link.json"
    tell(path, replace(STATE, cause="torn\nin two \udce9 " + "x" * 10_000))
    (noted,) = LinkNotes(path, uplink=False).after([], 200 * MS)
    assert isinstance(noted, LinkChanged)
    assert noted.cause.startswith("torn in two \\udce9 xxx")
    assert len(noted.cause.encode()) < 2100


def test_only_what_a_relay_tells_is_counted(tmp_path: Path) -> None:
    """Unknown names would fill the tables of counters."""
    path = tmp_path / "link.json"
    errors = ReleaseErrors()
    errors.observe(5)
    told = errors.in_ns() | {"overflow": 1, "stalled": 2}
    path.with_suffix(".released").write_text(json.dumps(told | {"another": 3}))
    counted = LinkNotes(path, uplink=True).after([], 0)
    assert [one.name for one in counted if isinstance(one, Counted)] == [
        f"uplink_{name}" for name in told
    ]


def test_it_is_told_in_words(tmp_path: Path) -> None:
    path = tmp_path / "link.json"
    tell(path, SET)
    (changed,) = LinkNotes(path, uplink=False).after([], 1000 * MS)
    assert isinstance(changed, LinkChanged)
    assert in_words(changed) == "link: downlink 120 ± 5 ms, loss 2 % (downlink.delay_ms=120)"


def test_a_change_of_the_other_direction_is_recorded_but_not_fed(
    tmp_path: Path,
) -> None:
    path, began = tmp_path / "link.json", [GuardChange(0, GuardState.TRACK, "fresh command")]
    notes, recorded = LinkNotes(path, uplink=False), list[Record]()
    slower = {**STATE.profile, "downlink": {"delay_ms": 120.0}}
    states = [
        STATE,
        replace(STATE, since_ns=300 * MS, cause="uplink.loss=0.1"),
        replace(SET, since_ns=500 * MS, cause="slower", profile=slower),
        replace(STATE, since_ns=700 * MS, cause="back"),
    ]
    reader, writer = os.pipe()
    feed = Feed(writer, watched=False)
    for n, state in enumerate(states):
        tell(path, state)
        for later, records in ((0, []), (1, began)):
            noted = notes.after(records, (200 * n + later) * MS)
            recorded += noted
            feed.tell(noted)
    causes = [one.cause for one in recorded if isinstance(one, LinkChanged)]
    assert causes == [cause for cause in ("", "uplink.loss=0.1", "slower", "back") for _ in "ab"]
    said = os.read(reader, 4096).decode().splitlines()
    assert [line.rpartition("(")[2] for line in said] == ["slower)", "back)"]
    os.close(reader)
    os.close(writer)


def test_how_late_a_relay_is_is_noted_every_other_second(tmp_path: Path) -> None:
    path = tmp_path / "uplink.json"
    notes, said = LinkNotes(path, uplink=True), list[list[Record]]()
    told = path.with_suffix(".released")
    for at, text in ((0, ""), (2000, '{"released": 7, "overflow": 0}'), (3000, ""), (4000, "[1]")):
        told.write_text(text)
        said.append(notes.after([], at * MS))
    assert said == [
        [],
        [Counted(2000 * MS, "link", "uplink_released", 7),
         Counted(2000 * MS, "link", "uplink_overflow", 0)],
        [],
        [],
    ]  # fmt: skip
