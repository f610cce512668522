"""One end as a process of its own: signals stop it, what it records goes to its file and its feed.

It ends on SIGTERM or SIGINT, and when the process that started it is gone.

What an end records of the link that shapes what it sends: the link's state file in, records out.

The link's process publishes its state whenever it has changed it (`cloudrc/link/state.py`). A look
at the file costs a system call and is made ten times a second. How late a relay's datagrams left is
in a file beside it, and noted every other second. The link's process is not trusted: whatever its
files hold, the loop goes on.
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
from cloudrc.errors import in_one_line
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
    from cloudrc.link.verify.monitor import StandingCheck


PERIOD_NS = 100_000_000
"""Between two looks [ns]."""
RELEASED_PERIOD_NS = 2_000_000_000
"""Between two notes of how late datagrams left [ns]."""
BEGINNINGS = frozenset({SessionOpened, GuardChange, MissionEvent})
"""With these a mission begins: a recording that is cut there has to say what the link was."""
NONSENSE = (OSError, ValueError, TypeError, AttributeError, OverflowError, RecursionError)
"""What comes of a file that cannot be read, or in which stands what nobody would write."""


class LinkNotes:
    """Follows the file; what cannot be read changes nothing, what is too long is not noted."""

    def __init__(self, path: Path, *, uplink: bool) -> None:
        """Follow the file at `path`, which need not be there yet.

        Args:
            path: State of the link.
            uplink: Which direction this end sends in.
        """
        self._path, self._place, self._uplink = path, str(path), uplink
        self._seen: tuple[int, int, int] | None = None
        self._since_ns: int | None = None
        self._note: LinkChanged | None = None
        self._released = path.with_suffix(RELEASED_SUFFIX)
        self._due_ns = self._released_ns = self._noted_ns = 0

    def after(self, records: Iterable[Record], now_ns: int, slip_ns: int = 0) -> list[Record]:
        """Say what there is to be noted after these records.

        Args:
            records: What the end has just recorded.
            now_ns: The machine's monotonic clock [ns].
            slip_ns: By how much the end's own clock lags [ns].

        Returns:
            One record if the link has changed or a mission may have begun; now and then those of
            how late a relay is.
        """
        if now_ns >= self._released_ns:
            self._released_ns = now_ns + RELEASED_PERIOD_NS
            return self._changed(records, now_ns, slip_ns) + self._late(now_ns - slip_ns)
        return self._changed(records, now_ns, slip_ns)

    def _changed(self, records: Iterable[Record], now_ns: int, slip_ns: int) -> list[Record]:
        changed = now_ns >= self._due_ns and self._look(now_ns)
        if not changed and BEGINNINGS.isdisjoint(map(type, records)):
            return []
        note, later = self._note, (now_ns - self._noted_ns) * 1e-9
        if note is None:
            return []
        age, time_line = note.age + later, note.time_line + later
        return [note._replace(stamp_ns=now_ns - slip_ns, age=age, time_line=time_line)]

    def _late(self, stamp_ns: int) -> list[Record]:
        """Say how late datagrams left since the relay began; nothing where none does."""
        try:
            told = json.loads(read(self._released, STATE_MAX))
            counts = {name: int(n) for name, n in told.items() if name in RELEASED}
        except NONSENSE:
            return []
        way = "uplink" if self._uplink else "downlink"
        return [Counted(stamp_ns, "link", f"{way}_{name}", n) for name, n in counts.items()]

    def _look(self, now_ns: int) -> bool:
        """Read the file if it is another one; say whether the state has changed."""
        self._due_ns = now_ns + PERIOD_NS
        seen = version(self._place)
        if seen == self._seen:
            return False
        self._seen = seen  # nonsense stays nonsense until it is another file
        try:
            state = from_text(read(self._path, STATE_MAX).decode())
            self._note = _note(state, self._uplink, now_ns)
        except TooLongError:  # a long time line is in force, and nothing that was noted before
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
        shaper=in_one_line(state.shaper),
        cause=in_one_line(state.cause),
        age=max(0, now_ns - state.since_ns) * 1e-9,
        time_line=time_line,
        delay=asked.get("delay", nan),
        jitter=asked.get("jitter", nan),
        loss=asked.get("loss", nan),
        rate=asked.get("rate", nan),
        conditions=json.dumps(state.profile.get(state.direction, {})),
    )


PARENT = "CLOUDRC_PARENT"
"""Variable of the environment in which a supervisor tells its own process id."""


class StopSignal:
    """True once the process shall end.

    To be made first of all: the first process of a container ignores SIGTERM until then.
    """

    def __init__(self) -> None:
        """Take over SIGTERM and SIGINT, and remember who started this process."""
        self._asked = False
        # As it was told by who started this: that may be gone by the time this line is reached.
        told = os.environ.pop(PARENT, "")
        self._parent = int(told) if told.isdecimal() else os.getppid()
        for number in (signal.SIGTERM, signal.SIGINT):
            signal.signal(number, self._ask)

    def __call__(self) -> bool:
        """Say whether somebody has asked for the end, or nobody is left to ask."""
        return self._asked or os.getppid() != self._parent

    def _ask(self, number: int, frame: FrameType | None) -> None:
        self._asked = True


class Takes(Recorder, Protocol):
    """A recorder that records can be put into; `cloudrc.record.recorder` has it.

    Attributes:
        error: Why something was not recorded, in words; "" if all is well.
        dropped: How many records did not reach the file.
    """

    error: str

    @property
    def dropped(self) -> int:
        """Number of records that did not reach the file."""

    def put(self, records: Iterable[Record]) -> None:
        """Take records over; never waits and never raises."""


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
    check: StandingCheck | None = None,
    keys: KeyFile | None = None,
) -> bool:
    """Fly one end until it is asked to stop or `over()`; its recording is whole afterwards.

    Args:
        endpoint: World or cloud.
        peer: Its socket.
        recorder: Where its records go.
        end: "world" or "cloud".
        stop: Made before anything that takes its time, so that nobody asks in vain.
        over: Whether this end is done by itself.
        slip_ns: By how much world's clock lags [ns].
        exporter: Gets the records too, if they are to become metrics.
        watched: Whether a supervisor reads the feed.
        choose: Says what of its records is recorded.
        link: File in which the link tells its state; its changes are recorded.
        check: Judges the link by what this end hears.
        keys: Followed, if there is such a file.

    Returns:
        True if it was done by itself, False if it was stopped.
    """
    feed, thread = Feed.on_stdout(watched=watched), RecordingThread(recorder)
    watch = _Watch(end, link, check, keys, slip_ns, thread.take_steps)
    taps = _Taps(end, recorder, feed, exporter, choose, watch)
    if exporter is not None:
        exporter.recording(thread.sync_age)
    thread.start()
    feed.ready()
    try:
        serve(endpoint, peer, end=end, sink=taps, stop=lambda: stop() or over(), slip_ns=slip_ns)
    finally:
        taps.record_losses(time.monotonic_ns() - slip_ns())
        thread.stop()
    return over()


class _Watch:
    """What an end notes beside its flight: new keys, the link, a wall clock that was set."""

    def __init__(
        self,
        end: str,
        link: Path | None,
        check: StandingCheck | None,
        keys: KeyFile | None,
        slip_ns: Callable[[], int],
        clock_steps: Callable[[], list[float]],
    ) -> None:
        self._clock_steps = clock_steps
        self._notes = LinkNotes(link, uplink=end == "world") if link is not None else None
        self._check, self._keys, self._slip_ns = check, keys, slip_ns

    def after(self, records: list[Record]) -> list[Record]:
        """Say what is to be noted after these records."""
        now_ns, slip_ns = time.monotonic_ns(), self._slip_ns()
        noted: list[Record] = [told(step, now_ns - slip_ns) for step in self._clock_steps()]
        if self._keys is not None:
            noted += self._keys.follow(now_ns)
        if self._notes is not None:
            noted += self._notes.after(records, now_ns, slip_ns)
        if self._check is not None:
            noted += self._check.after([*records, *noted], now_ns - slip_ns)
        return noted


class _Taps:
    """Where an end's records go: into its recording, to who watches, into its metrics."""

    def __init__(
        self,
        end: str,
        recorder: Takes,
        feed: Feed,
        exporter: Exporter | None,
        choose: Callable[[list[Record]], list[Record]],
        watch: _Watch,
    ) -> None:
        self._end, self._recorder, self._feed = end, recorder, feed
        self._exporter, self._choose, self._watch = exporter, choose, watch
        self._trouble, self._dropped = "", 0

    def __call__(self, records: list[Record]) -> None:
        """Take records in; never waits."""
        recorder, exporter = self._recorder, self._exporter
        records = records + self._watch.after(records)
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
        """Note in the recording what did not reach it."""
        self._recorder.put([self._losses(stamp_ns)])

    def _losses(self, stamp_ns: int) -> Counted:
        return Counted(stamp_ns, self._end, "recorder_dropped", self._recorder.dropped)
