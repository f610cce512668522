# SPDX-License-Identifier: Apache-2.0

"""An end as a process: its end, its feed, and what it records of the link and the clock."""

import json
import os
import time
from dataclasses import replace
from types import SimpleNamespace
from unittest.mock import Mock, call

import pytest

from cloudrc.base.files import write_atomically
from cloudrc.flight.pod import process
from cloudrc.flight.pod.exporter import Exporter
from cloudrc.flight.pod.process import (
    PARENT,
    PERIOD_NS,
    EndProcess,
    Feed,
    GracefulStop,
    LinkNotes,
    StopSignal,
    from_line,
    in_words,
)
from cloudrc.link.state import LinkState, to_text
from cloudrc.wire.messages import GuardState
from cloudrc.wire.records import (
    Fault,
    GuardChange,
    LinkChanged,
    MissionEvent,
    SessionOpened,
    TelemetrySent,
)
from tests.support.told import told as sample


def test_it_ends_if_it_is_not_the_child_of_who_has_started_it(monkeypatch):
    for told, ends in ((os.getppid(), False), (os.getpid(), True)):
        monkeypatch.setenv(PARENT, str(told))
        assert StopSignal()() is ends
        assert PARENT not in os.environ  # children must not inherit it
    assert StopSignal()() is False, "nothing was told"


def test_a_process_ends_once_its_work_is_done_or_after_its_limit(monkeypatch):
    asked, done, begun, now_ns = False, False, [], 0
    monkeypatch.setattr(time, "monotonic_ns", lambda: now_ns)
    ends = GracefulStop(lambda: asked, lambda: done, 800, lambda: begun.append(now_ns))
    assert not ends()
    now_ns, asked = 10_000, True
    assert not ends()
    done = True
    assert ends()
    done = False
    for passed_ns, ended in ((799, False), (800, True)):
        now_ns = 10_000 + passed_ns
        assert ends() is ended
    assert begun == [10_000]


EVENT = MissionEvent(5, "reached", 1, 'waypoint "2" of 7 \u2013 reached')


@pytest.fixture
def pipe():
    reader, writer = os.pipe()
    os.set_blocking(reader, False)
    yield reader, writer
    os.close(reader)
    os.close(writer)


def test_events_are_all_told_and_samples_ten_times_a_second(pipe):
    feed = Feed(pipe[1])
    alive = feed.alive_while(lambda: True)
    assert [alive(), alive()] == [True, True], "a sign of life, not more often than it says"
    for k in range(20):
        feed.tell([sample(k * PERIOD_NS // 4), EVENT])
    ready, *lines = os.read(pipe[0], 1 << 20).decode().splitlines()
    told = [from_line(line) for line in lines]
    assert ready == "ready"
    assert repr(told[:2]) == repr([sample(0), EVENT])  # with the types of all values
    assert [type(record) for record in told].count(TelemetrySent) == 5
    assert told.count(EVENT) == 20


def test_where_nobody_watches_events_are_said_in_words(pipe):
    feed = Feed(pipe[1], watched=False)
    feed.tell([sample(0), EVENT, EVENT._replace(text="caf\udce9")])
    assert feed.alive_while(lambda: True)()
    assert os.read(pipe[0], 1 << 20) == f"{EVENT.text}\ncaf\\udce9\n".encode()


MS = 1_000_000
STATE = LinkState(
    *("relay", "link.mode=relay", "relay", "downlink"),
    profile={"uplink": {"delay_ms": 45.0}, "downlink": {"delay_ms": 20.0, "jitter_ms": 5.0}},
    since="2026-01-02T03:04:05+00:00",
    since_ns=100 * MS,
    asked={"delay": 0.02, "jitter": 0.005, "loss": 0.0, "rate": None},
)
SET = replace(
    STATE,
    **{"since_ns": 950 * MS, "changes": 1, "change": "a1", "cause": "downlink.delay_ms=120"},
    asked={"delay": 0.12, "jitter": 0.005, "loss": 0.02, "rate": 2e6},
    origin_ns=600 * MS,
)
BEGINS = [GuardChange(0, GuardState.TRACK, "mission started")]


@pytest.fixture
def path(tmp_path):
    return tmp_path / "link.json"


def tell(path, state):
    write_atomically(path, to_text(state).encode())


def test_a_change_is_recorded_once_and_again_at_a_mission_start(path):
    check = Mock()
    notes = LinkNotes(path, uplink=False, check=check)
    assert notes.after(BEGINS, 0) == []
    tell(path, STATE)
    (first,) = notes.after([], 200 * MS)
    assert first._replace(rate=0.0) == LinkChanged(
        stamp_ns=200 * MS, uplink=False, shaper="relay", cause="", age=pytest.approx(0.1),
        time_line=pytest.approx(0.2), delay=0.02, jitter=0.005, loss=0.0, rate=0.0,
        conditions=json.dumps({"delay_ms": 20.0, "jitter_ms": 5.0}),
    )  # fmt: skip
    assert str(first.rate) == "nan"
    assert notes.after([], 400 * MS) == []
    tell(path, SET)
    assert notes.after([], 499 * MS) == [], "the file is looked at ten times a second"
    (changed,) = notes.after([], 1000 * MS, 30 * MS)
    assert (changed.stamp_ns, changed.cause) == (970 * MS, "downlink.delay_ms=120")
    assert (changed.age, changed.time_line) == pytest.approx((0.05, 0.4))
    assert (changed.delay, changed.loss, changed.rate) == (0.12, 0.02, 2e6)
    assert in_words(changed) == "link: downlink 120 ± 5 ms, loss 2 % (downlink.delay_ms=120)"
    (again,) = notes.after([SessionOpened(0, "cloud", 1, "")], 1010 * MS)
    later = {"age": pytest.approx(0.06), "time_line": pytest.approx(0.41)}
    assert again == changed._replace(stamp_ns=1010 * MS, **later)
    assert check.request.mock_calls == [call(STATE.profile), call(SET.profile)]


@pytest.fixture
def end(path, pipe):
    """World's process with a key that has just changed; `put` is what it has recorded."""
    put = []
    recorder = SimpleNamespace(
        **{"put": put.extend, "error": "", "dropped": 0},
        **dict.fromkeys(("start", "stop", "sync_age"), lambda: None),
    )
    keys = SimpleNamespace(follow=lambda now_ns: [Fault(now_ns, "key", "new key")])
    feed = Feed(pipe[1], watched=False)
    check = SimpleNamespace(after=lambda records, now_ns: [], request=lambda profile: None)
    made = EndProcess("world", None, recorder, keys, feed, path, check, Exporter("world"))
    made.recorded = put
    return made


def test_an_end_tells_of_its_clock_key_link_and_recorder(end, path, pipe, monkeypatch):
    tell(path, STATE)
    slip_ns, true = 5_000_000_000, time.time
    began_ns = time.monotonic_ns() - slip_ns
    end.recorder.error, end.recorder.dropped = "recording stopped: the disk is full", 7
    monkeypatch.setattr(time, "time", lambda: true() + 60.0)
    monkeypatch.setattr(process, "serve", lambda *_, sink, **__: (sink([EVENT]), sink([EVENT])))
    end.run(None, lambda: True, lambda: True, lambda: slip_ns)
    names = [getattr(record, "code", type(record).__name__) for record in end.recorded]
    first = ["MissionEvent", "wall_clock", "key", "LinkChanged"]
    assert names == [*first, "MissionEvent", "key", "LinkChanged", "Counted"]
    assert 0 <= end.recorded[1].stamp_ns - began_ns < 1_000_000_000
    page = end.exporter.text()
    assert "cloudrc_clock_steps_total 1.0" in page
    assert "cloudrc_recorder_dropped_records_total 7.0" in page
    said = os.read(pipe[0], 4096).decode()
    assert said.count("wall clock stepped by +60.0 s: ") == 1
    assert said.count(end.recorder.error) == 1
