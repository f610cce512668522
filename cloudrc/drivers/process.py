"""One end as a process of its own: signals stop it, what it records goes to its file and its feed.

It ends on SIGTERM or SIGINT, and when the process that started it is gone.
"""

from __future__ import annotations

import os
import signal
import time
from collections.abc import Callable, Iterable
from pathlib import Path
from types import FrameType
from typing import TYPE_CHECKING, Protocol

from cloudrc.drivers.feed import Feed
from cloudrc.drivers.keyfile import KeyFile
from cloudrc.drivers.link_notes import LinkNotes
from cloudrc.drivers.realtime import Peer, serve
from cloudrc.drivers.recording import Recorder, RecordingThread
from cloudrc.drivers.wall_clock import told
from cloudrc.endpoint import Endpoint
from cloudrc.records import Counted, Fault, Record

if TYPE_CHECKING:
    from cloudrc.drivers.exporter import Exporter
    from cloudrc.link.verify.monitor import StandingCheck


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
