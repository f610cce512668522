"""Run one end as a process: record its data, feed its supervisor, and stop on signals.

The process ends on SIGTERM or SIGINT, or when its parent process is gone.

An end also records the state of its outgoing link. The link's process publishes the state in a file
(`cloudrc/link/state.py`), which the end checks ten times a second. A second file tells how late the
relay's datagrams left. The end does not trust the link's process: whatever these files contain, the
loop continues.
"""

from __future__ import annotations

import json
import os
import signal
import time
from collections.abc import Callable, Iterable
from math import nan
from pathlib import Path
from types import FrameType
from typing import TYPE_CHECKING, Protocol

from cloudrc.drivers.feed import Feed
from cloudrc.drivers.keyfile import KeyFile
from cloudrc.drivers.realtime import Peer, serve
from cloudrc.drivers.recording import Recorder, RecordingThread, told
from cloudrc.endpoint import Endpoint
from cloudrc.errors import to_one_line
from cloudrc.files import TooLongError, read, version
from cloudrc.link.state import RELEASED, RELEASED_SUFFIX, STATE_MAX, LinkState, from_text
from cloudrc.records import (
    Counted,
    Fault,
    GuardChange,
    LinkChanged,
    MissionEvent,
    Record,
    SessionOpened,
)

if TYPE_CHECKING:
    from cloudrc.drivers.exporter import Exporter
    from cloudrc.link.verify.monitor import LinkMonitor


PERIOD_NS = 100_000_000
"""Time between two checks of the state file [ns]."""
RELEASED_PERIOD_NS = 2_000_000_000
"""Time between two records of how late the relay's datagrams left [ns]."""
BEGINNINGS = frozenset({SessionOpened, GuardChange, MissionEvent})
"""Types of records at which a mission may begin. A recording may be cut at such a record; therefore
the link's state is recorded again after it."""
NONSENSE = (OSError, ValueError, TypeError, AttributeError, OverflowError, RecursionError)
"""Errors that an unreadable or malformed file can raise."""


class LinkNotes:
    """Turns the link's state file into records.

    An unreadable file changes nothing. A file that is too long is not recorded.
    """

    def __init__(self, path: Path, *, uplink: bool) -> None:
        """Follow the file at `path`, which need not exist yet.

        Args:
            path: State file of the link.
            uplink: Whether this end sends on the uplink.
        """
        self._path, self._name, self._uplink = path, str(path), uplink
        self._seen: tuple[int, int, int] | None = None
        self._since_ns: int | None = None
        self._note: LinkChanged | None = None
        self._released = path.with_suffix(RELEASED_SUFFIX)
        self._due_ns = self._released_ns = self._noted_ns = 0

    def after(self, records: Iterable[Record], now_ns: int, slip_ns: int = 0) -> list[Record]:
        """Return the records about the link that follow these records.

        Args:
            records: Records that the end has just made.
            now_ns: The machine's monotonic clock [ns].
            slip_ns: Lag of the end's own clock [ns].

        Returns:
            A record if the link has changed or a mission may have begun. Every `RELEASED_PERIOD_NS`
            also records of how late the relay's datagrams left.
        """
        if now_ns >= self._released_ns:
            self._released_ns = now_ns + RELEASED_PERIOD_NS
            return self._changed(records, now_ns, slip_ns) + self._late(now_ns - slip_ns)
        return self._changed(records, now_ns, slip_ns)

    def _changed(self, records: Iterable[Record], now_ns: int, slip_ns: int) -> list[Record]:
        changed = now_ns >= self._due_ns and self._poll(now_ns)
        if not changed and BEGINNINGS.isdisjoint(map(type, records)):
            return []
        note, later = self._note, (now_ns - self._noted_ns) * 1e-9
        if note is None:
            return []
        age, time_line = note.age + later, note.time_line + later
        return [note._replace(stamp_ns=now_ns - slip_ns, age=age, time_line=time_line)]

    def _late(self, stamp_ns: int) -> list[Record]:
        """Return records of how late datagrams left since the relay began; none without a relay."""
        try:
            found = json.loads(read(self._released, STATE_MAX))
            counts = {name: int(n) for name, n in found.items() if name in RELEASED}
        except NONSENSE:
            return []
        way = "uplink" if self._uplink else "downlink"
        return [Counted(stamp_ns, "link", f"{way}_{name}", n) for name, n in counts.items()]

    def _poll(self, now_ns: int) -> bool:
        """Read the file if it was replaced, and return whether the state has changed."""
        self._due_ns = now_ns + PERIOD_NS
        seen = version(self._name)
        if seen == self._seen:
            return False
        self._seen = seen  # do not read a malformed file twice
        try:
            state = from_text(read(self._path, STATE_MAX).decode())
            self._note = _note(state, self._uplink, now_ns)
        except TooLongError:  # a long time line is in force: the last note no longer holds
            self._note = self._since_ns = None
            return False
        except NONSENSE:
            return False
        before_ns, self._since_ns = self._since_ns, state.since_ns
        self._noted_ns = now_ns
        return before_ns != state.since_ns


def _note(state: LinkState, uplink: bool, now_ns: int) -> LinkChanged:
    asked = {key: nan if value is None else float(value) for key, value in state.asked.items()}
    time_line = nan if state.origin_ns is None else (now_ns - state.origin_ns) * 1e-9
    return LinkChanged(
        stamp_ns=now_ns,
        uplink=uplink,
        shaper=to_one_line(state.shaper),
        cause=to_one_line(state.cause),
        age=max(0, now_ns - state.since_ns) * 1e-9,
        time_line=time_line,
        delay=asked.get("delay", nan),
        jitter=asked.get("jitter", nan),
        loss=asked.get("loss", nan),
        rate=asked.get("rate", nan),
        conditions=json.dumps(state.profile.get(state.direction, {})),
    )


PARENT = "CLOUDRC_PARENT"
"""Environment variable that holds the supervisor's process id."""


class StopSignal:
    """Tells whether the process must end.

    Create this object first: until then, the first process of a container ignores SIGTERM.
    """

    def __init__(self) -> None:
        """Handle SIGTERM and SIGINT, and remember the parent process."""
        self._asked = False
        # The supervisor passes its own id, since it may be gone before this line runs.
        parent = os.environ.pop(PARENT, "")
        self._parent = int(parent) if parent.isdecimal() else os.getppid()
        for number in (signal.SIGTERM, signal.SIGINT):
            signal.signal(number, self._ask)

    def __call__(self) -> bool:
        """Check whether a signal has arrived or the parent process is gone."""
        return self._asked or os.getppid() != self._parent

    def _ask(self, number: int, frame: FrameType | None) -> None:
        self._asked = True


class Takes(Recorder, Protocol):
    """A recorder that accepts records, such as the recorder in `cloudrc.record.recorder`.

    Attributes:
        error: Why something was not recorded, in words; "" without an error.
        dropped: Number of records that did not reach the file.
    """

    error: str

    @property
    def dropped(self) -> int:
        """Return the number of records that did not reach the file."""

    def put(self, records: Iterable[Record]) -> None:
        """Queue records, without waiting and without an exception."""


def run_end(
    endpoint: Endpoint,
    peer: Peer,
    recorder: Takes,
    *,
    end: str,
    stop: Callable[[], bool],
    over: Callable[[], bool] = lambda: False,
    slip_ns: Callable[[], int] = lambda: 0,
    exporter: Exporter | None = None,
    watched: bool = True,
    choose: Callable[[list[Record]], list[Record]] = list,
    link: Path | None = None,
    check: LinkMonitor | None = None,
    keys: KeyFile | None = None,
) -> bool:
    """Run one end until `stop()` or `over()`, then complete its recording.

    Args:
        endpoint: World or cloud.
        peer: Socket of the endpoint.
        recorder: Gets the endpoint's records.
        end: "world" or "cloud".
        stop: Whether somebody has asked this end to stop; create it before anything slow.
        over: Whether this end has finished by itself.
        slip_ns: Lag of world's clock [ns].
        exporter: Turns the records into metrics; None for no metrics.
        watched: Whether a supervisor reads the feed.
        choose: Selects the records that are recorded.
        link: State file of the link, whose changes are recorded; None without one.
        check: Compares the link with its profile by the datagrams that this end receives.
        keys: Key file, which may get new keys; None without a key file.

    Returns:
        True if the end finished by itself, False if it was stopped.
    """
    feed, thread = Feed.on_stdout(watched=watched), RecordingThread(recorder)
    observers = _Observers(end, link, check, keys, slip_ns, thread.take_steps)
    sink = _RecordSink(end, recorder, feed, exporter, choose, observers)
    if exporter is not None:
        exporter.recording(thread.sync_age)
    thread.start()
    feed.ready()
    try:
        ends = feed.alive_while(lambda: stop() or over())
        serve(endpoint, peer, end=end, sink=sink, stop=ends, slip_ns=slip_ns)
    finally:
        sink.record_losses(time.monotonic_ns() - slip_ns())
        thread.stop()
    return over()


class _Observers:
    """Records what happens around an end: new keys, link changes, steps of the wall clock."""

    def __init__(
        self,
        end: str,
        link: Path | None,
        check: LinkMonitor | None,
        keys: KeyFile | None,
        slip_ns: Callable[[], int],
        clock_steps: Callable[[], list[float]],
    ) -> None:
        self._clock_steps = clock_steps
        self._notes = LinkNotes(link, uplink=end == "world") if link is not None else None
        self._check, self._keys, self._slip_ns = check, keys, slip_ns

    def after(self, records: list[Record]) -> list[Record]:
        """Return the records to add after these records."""
        now_ns, slip_ns = time.monotonic_ns(), self._slip_ns()
        noted: list[Record] = [told(step, now_ns - slip_ns) for step in self._clock_steps()]
        if self._keys is not None:
            noted += self._keys.follow(now_ns)
        if self._notes is not None:
            noted += self._notes.after(records, now_ns, slip_ns)
        if self._check is not None:
            noted += self._check.after([*records, *noted], now_ns - slip_ns)
        return noted


class _RecordSink:
    """Passes an end's records to its recording, its feed and its metrics."""

    def __init__(
        self,
        end: str,
        recorder: Takes,
        feed: Feed,
        exporter: Exporter | None,
        choose: Callable[[list[Record]], list[Record]],
        observers: _Observers,
    ) -> None:
        self._end, self._recorder, self._feed = end, recorder, feed
        self._exporter, self._choose, self._observers = exporter, choose, observers
        self._trouble, self._dropped = "", 0

    def __call__(self, records: list[Record]) -> None:
        """Pass records on, without waiting."""
        recorder, exporter = self._recorder, self._exporter
        records = records + self._observers.after(records)
        recorder.put(self._choose(records))
        self._feed.tell(records)
        if exporter is not None:
            exporter.see(records)
            if records and recorder.dropped != self._dropped:
                self._dropped = recorder.dropped
                exporter.see([self._losses(records[-1].stamp_ns)])
        if records and recorder.error != self._trouble:
            self._trouble = recorder.error
            self._feed.tell([Fault(records[-1].stamp_ns, "recorder", self._trouble)])

    def record_losses(self, stamp_ns: int) -> None:
        """Record the number of records that were lost."""
        self._recorder.put([self._losses(stamp_ns)])

    def _losses(self, stamp_ns: int) -> Counted:
        return Counted(stamp_ns, self._end, "recorder_dropped", self._recorder.dropped)
