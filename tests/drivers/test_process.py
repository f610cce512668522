"""An end as a process: its end, its feed, and what it records of the link and the clock."""

import json
import os
import select
import signal
import subprocess
import sys
import time
from dataclasses import asdict, replace
from pathlib import Path
from types import SimpleNamespace

import pytest

from cloudrc.drivers import process
from cloudrc.drivers.exporter import Exporter
from cloudrc.drivers.process import (
    PARENT,
    PERIOD_NS,
    EndProcess,
    Feed,
    LinkNotes,
    StopSignal,
    from_line,
    in_words,
    to_line,
)
from cloudrc.drivers.teleop import LAST_WORD_NS, LastWord
from cloudrc.link.relay import ReleaseErrors
from cloudrc.link.state import STATE_MAX, LinkState, publish, to_text
from cloudrc.messages import UPRIGHT, ZERO, GuardState, Odometry, Telemetry
from cloudrc.records import (
    Counted,
    Fault,
    GuardChange,
    LinkChanged,
    MissionEvent,
    SessionOpened,
    TelemetrySent,
)

KILLED_AT_ONCE = """
import os, signal, sys
from pathlib import Path
from cloudrc.drivers.local import LocalRun
from cloudrc.drivers.realtime import free_ports

run, ways = LocalRun(Path(sys.argv[1]), print), ("world-side", "cloud-side", "world", "cloud")
addresses = [f"127.0.0.1:{port}" for port in free_ports(4)]
run._start("relay", **dict(zip(ways, addresses)))
print(run._children[0].process.pid, flush=True)
os.kill(os.getpid(), signal.SIGKILL)
"""
CONFIG = Path(__file__).parents[2] / "cloudrc" / "experiments" / "hover.yaml"


@pytest.mark.usefixtures("handlers")
@pytest.mark.parametrize(
    ("told", "ends"),
    [(None, False), (str(os.getppid()), False), (str(os.getpid()), True), ("nobody", False)],
    ids=["untold", "parent", "stranger", "nonsense"],  # process ids differ each time
)
def test_it_ends_if_it_is_not_the_child_of_who_has_started_it(told, ends, monkeypatch):
    monkeypatch.delenv(PARENT, raising=False)
    if told is not None:
        monkeypatch.setenv(PARENT, told)
    assert StopSignal()() is ends
    assert PARENT not in os.environ  # children must not inherit it


@pytest.mark.process
def test_it_ends_if_its_supervisor_was_killed_before_its_start(tmp_path):
    (tmp_path / "config.yaml").write_text(CONFIG.read_text())
    command = [sys.executable, "-c", KILLED_AT_ONCE, str(tmp_path)]
    supervisor = subprocess.run(command, capture_output=True, text=True, timeout=60)
    assert supervisor.returncode == -signal.SIGKILL, supervisor.stderr
    try:
        orphan = os.pidfd_open(int(supervisor.stdout))
    except ProcessLookupError:
        return  # it has already ended
    ended, _, _ = select.select([orphan], [], [], 30.0)
    if not ended:
        signal.pidfd_send_signal(orphan, signal.SIGKILL)
    os.close(orphan)
    assert ended
    assert (tmp_path / "relay.log").read_text().startswith("cloudrc relay: ")  # as after a signal


def test_cloud_ends_once_nothing_flies_or_after_its_last_word():
    asked = flies = False
    now_ns = 1_000_000_000
    ends = LastWord(lambda: asked, lambda: flies, lambda: now_ns)
    assert not ends()
    flies = True
    assert not ends()
    now_ns += 10_000_000_000
    asked = True
    assert not ends()
    now_ns += LAST_WORD_NS - 1
    assert not ends()
    flies = False
    assert ends()
    flies = True
    now_ns += 1
    assert ends()


def sent(stamp_ns):
    odometry = Odometry(stamp_ns, (1.0, 2.0, 3.0), UPRIGHT, ZERO, ZERO)
    telemetry = Telemetry(stamp_ns, odometry, 0.5, 1, 2, 3, 4, GuardState.TRACK, 2, 0.1)
    return TelemetrySent(stamp_ns, 1, 2, telemetry)


EVENT = MissionEvent(5, "reached", 1, 'waypoint "2" of 7 \u2013 reached')


@pytest.fixture
def pipe():
    reader, writer = os.pipe()
    os.set_blocking(reader, False)
    yield reader, writer
    os.close(reader)
    os.close(writer)


@pytest.mark.parametrize("record", [sent(7), EVENT, GuardChange(1, GuardState.HOLD, "why")])
def test_a_record_comes_back_as_it_was(record):
    assert repr(from_line(to_line(record))) == repr(record)  # with the types of all values


def test_events_are_all_told_and_samples_ten_times_a_second(pipe):
    feed = Feed(pipe[1])
    feed.ready()
    for k in range(20):
        feed.tell([sent(k * PERIOD_NS // 4), EVENT])
    lines = os.read(pipe[0], 1 << 20).decode().splitlines()
    assert lines[0] == "ready"
    told = [type(from_line(line)) for line in lines[1:]]
    assert (told.count(MissionEvent), told.count(TelemetrySent)) == (20, 5)


def test_where_nobody_watches_events_are_said_in_words(pipe):
    feed = Feed(pipe[1], watched=False)
    feed.tell([sent(0), EVENT, EVENT._replace(text="caf\udce9")])
    assert feed.alive_while(lambda: True)()
    assert os.read(pipe[0], 1 << 20) == f"{EVENT.text}\ncaf\\udce9\n".encode()


def test_a_watched_loop_gives_signs_of_life(pipe):
    ask = Feed(pipe[1]).alive_while(lambda: True)
    assert [ask(), ask()] == [True, True]
    assert os.read(pipe[0], 100) == b"ready\n"


def test_a_full_or_closed_pipe_does_not_block():
    reader, writer = os.pipe()
    feed = Feed(writer)
    for _ in range(5000):
        feed.tell([EVENT])
    os.close(reader)
    feed.tell([EVENT])
    os.close(writer)


def test_a_line_is_told_whole_however_long(pipe):
    """A pipe holds 64 KiB; the rest of a longer line is written before the next line."""
    feed, data = Feed(pipe[1]), b""
    long = EVENT._replace(text="x" * 150_000)
    for event in (long, EVENT, EVENT, EVENT):
        feed.tell([event])
        data += os.read(pipe[0], 1 << 20)
    *lines, rest = data.decode().split("\n")
    assert ([from_line(line) for line in lines], rest) == ([long, EVENT, EVENT], "")


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
BEGINS = [GuardChange(0, GuardState.TRACK, "mission started")]


@pytest.fixture
def path(tmp_path):
    return tmp_path / "link.json"


def tell(path, state):
    publish(path, to_text(state))


def test_a_change_is_recorded_once_and_again_at_a_mission_start(path):
    notes = LinkNotes(path, uplink=False)
    assert notes.after(BEGINS, 0) == []
    tell(path, STATE)
    (first,) = notes.after([], 200 * MS)
    assert first._replace(rate=0.0, time_line=0.0) == LinkChanged(
        stamp_ns=200 * MS, uplink=False, shaper="relay", cause="", age=pytest.approx(0.1),
        time_line=0.0, delay=0.02, jitter=0.005, loss=0.0, rate=0.0,
        conditions=json.dumps({"delay_ms": 20.0, "jitter_ms": 5.0}),
    )  # fmt: skip
    assert str(first.rate) == str(first.time_line) == "nan"
    tell(path, replace(STATE, refused="b2", refusal="netem cannot"))
    assert notes.after([], 400 * MS) == []
    tell(path, SET)
    (changed,) = notes.after([], 1000 * MS, 30 * MS)
    assert (changed.stamp_ns, changed.cause) == (970 * MS, "downlink.delay_ms=120")
    assert (changed.age, changed.time_line) == pytest.approx((0.05, 0.4))
    assert (changed.delay, changed.loss, changed.rate) == (0.12, 0.02, 2e6)
    assert in_words(changed) == "link: downlink 120 ± 5 ms, loss 2 % (downlink.delay_ms=120)"
    (again,) = notes.after([SessionOpened(0, "cloud", 1, "")], 1010 * MS)
    later = {"age": pytest.approx(0.06), "time_line": pytest.approx(0.41)}
    assert again == changed._replace(stamp_ns=1010 * MS, **later)


def test_the_file_is_looked_at_ten_times_a_second(path):
    tell(path, STATE)
    notes = LinkNotes(path, uplink=False)
    assert len(notes.after([], 200 * MS)) == 1
    tell(path, SET)
    assert [at for at in range(201, 400) if notes.after([], at * MS)] == [300]


@pytest.mark.parametrize(
    "wrong",
    [
        *({"asked": {"delay": "45 ms"}}, {"asked": [1]}, {"since_ns": "5"}),
        *({"since_ns": -(10**400)}, {"origin_ns": "5"}, {"profile": []}, {"direction": {}}),
        *({"shaper": 5}, {"reason": "x" * STATE_MAX}, "{", '{"shaper": "relay"}', "[" * 100_000),
        *('{"released": Infinity}', '{"released": [1]}', None),
    ],
    ids=lambda wrong: str(wrong)[:20],
)
def test_nonsense_in_either_file_is_recorded_as_nothing(path, wrong):
    """Neither is the state before it, which no longer holds; a pipe (None) is not waited for."""
    tell(path, STATE)
    notes = LinkNotes(path, uplink=False)
    assert len(notes.after([], 200 * MS)) == 1
    text = wrong if isinstance(wrong, str) else json.dumps(asdict(SET) | (wrong or {}))
    for file in (path, path.with_suffix(".released")):
        file.unlink(missing_ok=True)
        os.mkfifo(file) if wrong is None else file.write_text(text)
    assert notes.after(BEGINS, 2200 * MS) == []
    path.unlink()
    tell(path, SET)
    assert len(notes.after([], 2400 * MS)) == 1


def test_foreign_words_are_noted_in_one_line_that_can_be_written(path):
    tell(path, replace(STATE, cause="torn\nin two \udce9 " + "x" * 10_000))
    (noted,) = LinkNotes(path, uplink=False).after([], 200 * MS)
    assert noted.cause.startswith("torn in two \\udce9 xxx")
    assert len(noted.cause.encode()) < 2100


def test_how_late_a_relay_is_is_noted_every_other_second(path):
    """Unknown names would fill the tables of counters."""
    notes, errors = LinkNotes(path, uplink=True), ReleaseErrors()
    errors.observe(5)
    told = errors.in_ns() | {"overflow": 1, "stalled": 2}
    assert notes.after([], 0) == []
    path.with_suffix(".released").write_text(json.dumps(told | {"another": 3}))
    assert notes.after([], 1999 * MS) == []
    assert notes.after([], 2000 * MS) == [
        Counted(2000 * MS, "link", f"uplink_{name}", number) for name, number in told.items()
    ]


def test_a_change_of_the_other_direction_is_recorded_but_not_fed(path, pipe):
    notes, recorded, feed = LinkNotes(path, uplink=False), [], Feed(pipe[1], watched=False)
    slower = {**STATE.profile, "downlink": {"delay_ms": 120.0}}
    states = [
        STATE,
        replace(STATE, since_ns=300 * MS, cause="uplink.loss=0.1"),
        replace(SET, since_ns=500 * MS, cause="slower", profile=slower),
        replace(STATE, since_ns=700 * MS, cause="back"),
    ]
    for n, state in enumerate(states):
        tell(path, state)
        for later, records in ((0, []), (1, BEGINS)):
            noted = notes.after(records, (200 * n + later) * MS)
            recorded += noted
            feed.tell(noted)
    causes = [one.cause for one in recorded]
    assert causes == [cause for cause in ("", "uplink.loss=0.1", "slower", "back") for _ in "ab"]
    said = os.read(pipe[0], 4096).decode().splitlines()
    assert [line.rpartition("(")[2] for line in said] == ["slower)", "back)"]


def test_an_end_tells_of_its_clock_key_link_and_recorder(path, pipe):
    recorder = SimpleNamespace(error="", dropped=0)
    keys = SimpleNamespace(follow=lambda now_ns: [Fault(now_ns, "key", "new key")])
    exporter, feed = Exporter("world"), Feed(pipe[1], watched=False)
    tell(path, STATE)
    run = EndProcess("world", None, recorder, keys, feed, exporter, link=path)
    slip_ns = 5_000_000_000
    began_ns = time.monotonic_ns() - slip_ns
    noted = run.look_around([], slip_ns, [60.0, -1.0])
    assert [record.code for record in noted[:3]] == ["wall_clock", "wall_clock", "key"]
    assert [type(record) for record in noted[3:]] == [LinkChanged]
    assert 0 <= noted[0].stamp_ns - began_ns < 1_000_000_000
    run.tell(noted)
    assert "cloudrc_clock_steps_total 2.0" in exporter.text()
    recorder.error, recorder.dropped = "recording stopped: the disk is full", 7
    for _ in range(2):
        run.tell([EVENT])
    assert "cloudrc_recorder_dropped_records_total 7.0" in exporter.text()
    said = os.read(pipe[0], 4096).decode()
    assert said.count("wall clock stepped by +60.0 s: ") == 1
    assert said.count(recorder.error) == 1


def test_what_an_end_says_is_recorded_fed_and_exported(pipe, monkeypatch):
    put, exporter = [], Exporter("world")
    nothing = dict.fromkeys(("flush", "sync"), lambda **_: None)
    recorder = SimpleNamespace(
        put=put.extend, drain=lambda most: 0, close=lambda: None, error="", dropped=0, **nothing
    )
    keys = SimpleNamespace(follow=lambda now_ns: [Fault(now_ns, "key", "new key")])
    monkeypatch.setattr(process, "serve", lambda *_, sink, **__: sink([EVENT]))
    run = EndProcess("world", None, recorder, keys, Feed(pipe[1], watched=False), exporter)
    run.run(None, lambda: True, lambda: True)
    assert [type(record) for record in put] == [type(EVENT), Fault, Counted]
    assert "new key" in os.read(pipe[0], 4096).decode()
    assert exporter._seen_at is not None
