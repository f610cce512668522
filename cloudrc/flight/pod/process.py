# SPDX-License-Identifier: Apache-2.0

"""Run world or cloud as a process: record its data, report to the supervisor, stop on signals.

The process ends on SIGTERM or SIGINT, or when its parent process has ended. Its standard output is
a feed: a line of JSON for each event and for some samples. Plug-ins print to standard error.
"""

from __future__ import annotations

import json
import os
import signal
import time
from base64 import b64decode, b64encode
from collections.abc import Callable, Iterable
from contextlib import suppress
from dataclasses import dataclass
from functools import cache
from math import nan
from pathlib import Path
from types import FrameType
from typing import TYPE_CHECKING, get_args

from cloudrc.base.errors import to_one_line
from cloudrc.base.files import TooLongError, Watched, read
from cloudrc.flight.pod.keyfile import KeyFile
from cloudrc.flight.pod.realtime import Peer, serve
from cloudrc.flight.pod.recording import FlightsOnly, Recorder
from cloudrc.link.profile import PERIOD_KEYS, RANDOM
from cloudrc.link.state import RELEASED, RELEASED_SUFFIX, STATE_MAX, from_text
from cloudrc.results.exposition.live import CLOCK_SET
from cloudrc.wire.endpoint import Endpoint
from cloudrc.wire.records import (
    Control,
    Counted,
    Fault,
    FrameKept,
    GuardChange,
    LinkChanged,
    MissionEvent,
    Record,
    SessionOpened,
    TelemetrySent,
)

if TYPE_CHECKING:
    from pydantic import TypeAdapter

    from cloudrc.flight.pod.exporter import Exporter
    from cloudrc.flight.pod.link_monitor import LinkMonitor
    from cloudrc.flight.pod.readers import RecordSender

PARENT = "CLOUDRC_PARENT"
"""Environment variable with the process id of the supervisor."""
READY = "ready"
"""Line that a process prints once it can receive datagrams, and then every `ALIVE_PERIOD`."""
ALIVE_PERIOD = 1.0
"""Time between two lines `READY` while the loop of a process runs [s]."""
EVENTS = (GuardChange, MissionEvent, Fault, LinkChanged)
"""Types of records that are always part of the feed."""
SAMPLED = (TelemetrySent, Control)
"""Types of records of which the feed contains at most one record per type and `PERIOD_NS`."""
PERIOD_NS = 100_000_000
"""Shortest time between two records of a type in `SAMPLED`, and between two checks of the link's
state [ns]."""
RELEASED_PERIOD_NS = 2_000_000_000
"""Time between two records of the lateness with which the relay sends datagrams [ns]."""
BEGINNINGS = frozenset({SessionOpened, GuardChange, MissionEvent})
"""Types of records at which a mission may begin. After each of them, the state of the link is
recorded again, for recordings whose earlier part is cut off."""
CLOCK_STEP = 0.1
"""Smallest step of the wall clock that is recorded [s]."""
SINCE_BOOT = getattr(time, "CLOCK_BOOTTIME", time.CLOCK_MONOTONIC)  # Linux has CLOCK_BOOTTIME


class StopSignal:
    """Tells whether this process has to end.

    Create this object first: without it, the first process of a container ignores SIGTERM.
    """

    def __init__(self) -> None:
        self._asked = False
        # If the supervisor has ended before this line runs, getppid() is not the supervisor's id.
        self._parent = int(os.environ.pop(PARENT, os.getppid()))
        for number in (signal.SIGTERM, signal.SIGINT):
            signal.signal(number, self._ask)

    def __call__(self) -> bool:
        """Return whether a signal has arrived or the parent process has ended."""
        return self._asked or os.getppid() != self._parent

    def _ask(self, number: int, frame: FrameType | None) -> None:
        self._asked = True


class GracefulStop:
    """Delays the end of a process until it has done its last work, for a limited time."""

    def __init__(
        self,
        asked: Callable[[], bool],
        done: Callable[[], bool],
        limit_ns: int,
        begin: Callable[[], None] = lambda: None,
    ) -> None:
        """Set the functions that give the state of the process.

        After `asked()` has become true, `begin` is called once. The process may end as soon as
        `done()` is true, or `limit_ns` [ns] later.
        """
        self._asked, self._done, self._limit_ns, self._begin = asked, done, limit_ns, begin
        self._until_ns: int | None = None

    def __call__(self) -> bool:
        """Return whether the process has to end now; its loop calls this repeatedly."""
        if not self._asked():
            return False
        if self._until_ns is None:
            self._begin()  # may take long
            self._until_ns = time.monotonic_ns() + self._limit_ns
        return self._done() or time.monotonic_ns() >= self._until_ns


class Feed:
    """Writes all event records and some of the periodic records to a pipe, one record per line.

    It never blocks: it drops a line for which the pipe has no space.
    """

    def __init__(self, descriptor: int, *, watched: bool = True) -> None:
        """Make the pipe `descriptor` non-blocking.

        `watched` is True if a supervisor reads the pipe. Otherwise, as in a container, the pipe is
        a log, and the feed writes only events, as text for humans.
        """
        self._descriptor, self._watched = descriptor, watched
        self._told_ns: dict[type, int] = {}
        self._mission = 0  # number of the mission in the newest telemetry
        self._links: dict[bool, str] = {}
        self._rest = b""  # end of a line for which the pipe had no space
        os.set_blocking(descriptor, False)

    @classmethod
    def on_stdout(cls, *, watched: bool = True) -> Feed:
        """Make a feed that owns standard output; redirect other prints to standard error.

        `watched` is True if a supervisor reads standard output.
        """
        feed = cls(os.dup(1), watched=watched)
        os.dup2(2, 1)
        return feed

    def alive_while(self, stop: Callable[[], bool]) -> Callable[[], bool]:
        """Return a function that returns `stop()` and, every `ALIVE_PERIOD`, prints `READY`.

        `READY` tells a supervisor that this process can receive datagrams, and that it is alive.
        Without a supervisor, the function does not print.
        """
        due = 0.0

        def ask() -> bool:
            nonlocal due
            if self._watched and (now := time.monotonic()) >= due:
                due = now + ALIVE_PERIOD
                self._write(READY)
            return stop()

        return ask

    def tell(self, records: Iterable[Record]) -> None:
        """Write the events among the records; omit repeated records of the same link conditions.

        If a supervisor reads the pipe, also write some of the periodic records (`SAMPLED`).
        """
        for record in records:
            if isinstance(record, LinkChanged) and not self._is_news(record):
                continue
            if isinstance(record, EVENTS):
                self._write(to_line(record) if self._watched else in_words(record))
            elif self._watched and isinstance(record, SAMPLED) and self._is_due(record):
                self._write(to_line(record))

    def _is_news(self, record: LinkChanged) -> bool:
        """Return whether a record reports changed conditions, not those at the start."""
        last, self._links[record.uplink] = self._links.get(record.uplink), record.conditions
        return last != record.conditions and bool(record.cause)

    def _is_due(self, record: Record) -> bool:
        kind, stamp_ns = type(record), record.stamp_ns
        mission = record.telemetry.mission_id if isinstance(record, TelemetrySent) else -1
        starts = mission not in (-1, self._mission)
        if starts:
            self._mission = mission
        elif stamp_ns - self._told_ns.get(kind, stamp_ns - PERIOD_NS) < PERIOD_NS:
            return False
        self._told_ns[kind] = stamp_ns
        return True

    def _write(self, line: str) -> None:
        """Write the rest of the previous line, then `line`; drop `line` if the pipe is full."""
        data = line.encode(errors="backslashreplace") + b"\n"
        with suppress(OSError):  # the pipe is full or closed: continue without the feed
            self._rest = self._rest[os.write(self._descriptor, self._rest) :]
            if not self._rest:
                self._rest = data[os.write(self._descriptor, data) :]


def to_line(record: Record) -> str:
    """Format a record as one line of JSON: a list of the type's name and the fields' values.

    Bytes become text in base64.
    """
    return json.dumps(
        [type(record).__name__, record], default=lambda data: b64encode(data).decode()
    )


def in_words(event: GuardChange | MissionEvent | Fault | LinkChanged) -> str:
    """Describe an event in a line of text."""
    if isinstance(event, GuardChange):
        return f"guard: {event.state.name}, {event.cause}"
    if isinstance(event, LinkChanged):
        way = "uplink" if event.uplink else "downlink"
        jitter = f" ± {event.jitter * 1e3:g}" if event.jitter else ""
        loss = f", loss {event.loss * 100:.3g} %" if event.loss else ""
        return f"link: {way} {event.delay * 1e3:g}{jitter} ms{loss} ({event.cause})"
    return event.text


def from_line(line: str) -> Record:
    """Parse a line from `to_line`."""
    name, values = json.loads(line)
    if name == FrameKept.__name__:
        values[-1] = b64decode(values[-1])
    return _kind(name).validate_python(values)


@cache
def _kind(name: str) -> TypeAdapter[Record]:
    from pydantic import TypeAdapter

    return TypeAdapter({kind.__name__: kind for kind in get_args(Record)}[name])


class LinkNotes:
    """Makes records of the state of the link, for the direction in which this process sends.

    The link process writes the link's state to a file, and the lateness of its datagrams to a
    second file. World and cloud do not trust the content of these files.
    """

    def __init__(self, path: Path, *, uplink: bool, check: LinkMonitor) -> None:
        """Follow the state file at `path`, which may not exist yet; `uplink` is True in world.

        `check` gets each new profile.
        """
        self._state, self._uplink, self._check = Watched(path, PERIOD_NS), uplink, check
        self._released = Watched(path.with_suffix(RELEASED_SUFFIX), RELEASED_PERIOD_NS)
        self._since_ns: int | None = None

    def after(self, records: Iterable[Record], now_ns: int, slip_ns: int = 0) -> list[Record]:
        """Return records of the link's state and of its datagrams' lateness, if they are due.

        `now_ns` is the time on the machine's clock [ns]; `slip_ns` is the lag of world's or cloud's
        clock behind it [ns]. `records` are new records of world or cloud. If one of them has a type
        in `BEGINNINGS`, a mission may begin, and a record of the link's state is due at once.
        """
        noted: list[Record] = []
        begins = not BEGINNINGS.isdisjoint(map(type, records))
        try:
            if self._state.is_new(now_ns, at_once=begins) or begins:
                noted += self._read_state(begins, now_ns, slip_ns)
            if self._released.is_new(now_ns):
                noted += self._read_lateness(now_ns - slip_ns)
        except (OSError, ValueError):
            pass  # a missing or malformed file
        return noted

    def _read_lateness(self, stamp_ns: int) -> list[Counted]:
        found = json.loads(read(self._released.path, STATE_MAX))
        counts = {name: int(n) for name, n in found.items() if name in RELEASED}
        way = "uplink" if self._uplink else "downlink"
        return [Counted(stamp_ns, "link", f"{way}_{name}", n) for name, n in counts.items()]

    def _read_state(self, begins: bool, now_ns: int, slip_ns: int) -> list[LinkChanged]:
        """Return the link's state as a record if it is new or a mission `begins`, else []."""
        try:
            state = from_text(read(self._state.path, STATE_MAX).decode())
        except TooLongError:  # a long schedule
            self._since_ns = None
            self._check.request(None)
            return []
        since_ns, self._since_ns = self._since_ns, state.since_ns
        if since_ns != state.since_ns:
            self._check.request(state.profile)
        asked = {key: nan if value is None else float(value) for key, value in state.asked.items()}
        own = state.profile.get(state.direction, {})
        if state.profile.get("start_s") == RANDOM and not own.keys().isdisjoint(PERIOD_KEYS):
            own = {**own, "loop": True}
        changed = LinkChanged(
            stamp_ns=now_ns - slip_ns,
            uplink=self._uplink,
            shaper=to_one_line(state.shaper),
            cause=to_one_line(state.cause),
            age=max(0, now_ns - state.since_ns) * 1e-9,
            time_line=(now_ns - state.origin_ns) * 1e-9,
            **{name: asked.get(name, nan) for name in ("delay", "jitter", "loss", "rate")},
            conditions=json.dumps(own),
        )
        return [changed] if begins or since_ns != state.since_ns else []


@dataclass
class EndProcess:
    """The process of world or cloud: runs its endpoint, and records and reports the flight."""

    end: str  # "world" or "cloud"
    peer: Peer
    recorder: Recorder
    keys: KeyFile  # reloaded when it changes
    feed: Feed  # sends records to the supervisor
    link: Path  # file with the state of the link
    check: LinkMonitor  # compares the received datagrams with the link profile
    exporter: Exporter | None = None  # turns records into metrics
    flights_only: bool = False  # whether to record no samples while the robot does not fly
    readers: RecordSender | None = None  # sends records to other programs of this machine

    def __post_init__(self) -> None:
        self._notes = LinkNotes(self.link, uplink=self.end == "world", check=self.check)
        self._trouble, self._dropped = "", 0
        self._clock_offset = time.time() - time.clock_gettime(SINCE_BOOT)

    def run(
        self,
        endpoint: Endpoint,
        stop: Callable[[], bool],
        flies: Callable[[], bool],
        slip_ns: Callable[[], int] = lambda: 0,
    ) -> None:
        """Run the endpoint until `stop()` returns true, then complete the recording.

        `flies` returns whether the robot follows cloud; `slip_ns` returns the lag of the endpoint's
        clock behind the machine's monotonic clock [ns].
        """
        choose = FlightsOnly(flies) if self.flights_only else list
        if self.exporter is not None:
            self.exporter.sync_age = self.recorder.sync_age

        def sink(records: list[Record]) -> None:
            records = records + self.look_around(records, slip_ns())
            self.recorder.put(choose(records))
            if self.readers is not None:
                self.readers.put(records)
            self.tell(records)

        self.recorder.start()
        try:
            ends = self.feed.alive_while(stop)
            serve(endpoint, self.peer, end=self.end, sink=sink, stop=ends, slip_ns=slip_ns)
        finally:
            self.recorder.put([self._count_losses(time.monotonic_ns() - slip_ns())])
            self.recorder.stop()

    def tell(self, records: list[Record]) -> None:
        """Send records, and problems of the recorder, to supervisor and metrics."""
        recorder = self.recorder
        self.feed.tell(records)
        if records and recorder.error != self._trouble:
            self._trouble = recorder.error
            self.feed.tell([Fault(records[-1].stamp_ns, "recorder", self._trouble)])
        if self.exporter is not None:
            if records and recorder.dropped != self._dropped:
                self._dropped = recorder.dropped
                records = [*records, self._count_losses(records[-1].stamp_ns)]
            self.exporter.see(records)

    def look_around(self, records: list[Record], slip_ns: int) -> list[Record]:
        """Return new records about wall-clock steps, changed keys and the state of the link.

        `records` are the newest records of the endpoint. `slip_ns` is the lag of the endpoint's
        clock behind the machine's monotonic clock [ns].
        """
        now_ns = time.monotonic_ns()
        noted: list[Record] = []
        if step := self._clock_step():
            text = f"wall clock stepped by {step:+.1f} s: the flight is not affected"
            noted.append(Fault(now_ns - slip_ns, CLOCK_SET, text))
        noted += self.keys.follow(now_ns)
        noted += self._notes.after(records, now_ns, slip_ns)
        return noted + self.check.after([*records, *noted], now_ns - slip_ns)

    def _clock_step(self) -> float:
        """Return the step of the wall clock since the last call [s]; 0 without a step."""
        before, wall = time.clock_gettime(SINCE_BOOT), time.time()
        boot = time.clock_gettime(SINCE_BOOT)
        if boot - before > CLOCK_STEP / 2.0:
            return 0.0  # the process was paused while it read the clocks: the next call compares
        step, self._clock_offset = wall - boot - self._clock_offset, wall - boot
        return step if abs(step) > CLOCK_STEP else 0.0

    def _count_losses(self, stamp_ns: int) -> Counted:
        return Counted(stamp_ns, self.end, "recorder_dropped", self.recorder.dropped)
