"""Monitor the link in flight: every 5 s compare what an end receives with what is predicted.

World judges the downlink, cloud the uplink. The control loop only hands over its records; a thread
of the monitor does the rest.
"""

from __future__ import annotations

import queue
import threading
import time
from collections import deque
from collections.abc import Callable, Sequence
from math import isnan, nan
from pathlib import Path
from typing import TypeAlias

import numpy as np

from cloudrc.errors import describe_error
from cloudrc.files import TooLongError, read
from cloudrc.link.model import Stream
from cloudrc.link.profile import DirectionProfile, Timeline, settled
from cloudrc.link.state import STATE_MAX, from_text
from cloudrc.link.verify.causes import describe
from cloudrc.link.verify.judge import FEWEST, RUN_LENGTH, Flow, Plan, Row, told, verdict_of
from cloudrc.records import Arrival, Fault, Lateness, LinkChecked, Record

PERIOD = 0.01
"""Period of telemetry and of commands [s]."""
CHECK_NS, SETTLE_NS = 5_000_000_000, 2_000_000_000
"""Time between two verdicts, and from a new session or profile to the first datagram [ns]."""
KEPT, FINAL = 6000, 128
"""Most datagrams that are judged [1]; a missing datagram counts as lost after FINAL newer ones."""
FOLLOW_PERIOD = 0.1
"""Time between two readings of the records and of the link's state file [s]."""
DELAYS = {"mean", "deviation"}
"""Quantities that are judged only if the ends share a clock."""

Asked: TypeAlias = tuple[DirectionProfile, DirectionProfile]
"""Profiles of uplink and downlink."""
Load: TypeAlias = Callable[[object], Asked]
"""Makes the profiles from the values in the link's state file; raises a CloudrcError."""


class LinkMonitor:
    """Judge the direction of the link that one end receives, from the records of this end."""

    def __init__(self, *, uplink: bool, flow: Flow) -> None:
        """Set the direction and its datagrams; then call `begin` or, without a thread, `follow`."""
        self._uplink, self._flow = uplink, flow
        self._arrivals, self._lates = deque[Arrival](maxlen=KEPT), deque[float](maxlen=KEPT)
        self._asked: DirectionProfile | None = None
        self._plan: Plan | None = None
        self._epoch, self._fresh, self._seen = -1, True, ""
        self._since_ns, self._due_ns = 0.0, 0
        self._suspects, self._complained = set[str](), False
        self._pause: Callable[[], None] = lambda: None
        self._inbox: queue.SimpleQueue[tuple[Sequence[Record], int]] | None = None
        self._outbox = queue.SimpleQueue[Record]()

    def begin(self, asked: Asked, path: Path | None, load: Load) -> None:
        """Start the thread; `asked` holds until the link's state file at `path` reports others."""
        self._inbox, self._pause = queue.SimpleQueue(), lambda: time.sleep(1e-4)
        self.follow(asked)
        threading.Thread(target=self._run, args=(path, load), name="link", daemon=True).start()

    def follow(self, asked: Asked | None) -> None:
        """Compare with other profiles from now on; None: with none until they are known."""
        own = asked and asked[0 if self._uplink else 1]
        if own != self._asked:
            self._asked, self._fresh, self._plan = own, True, None
            if own is not None:
                sent = np.arange(float(RUN_LENGTH)) * PERIOD
                self._plan = Plan(settled(own), self._flow, sent, pause=self._pause)

    def after(self, records: Sequence[Record], now_ns: int) -> list[Record]:
        """Take the newest records of this end at `now_ns`; return records about the link."""
        if self._inbox is None:
            return self._see(records, now_ns)
        self._inbox.put((records, now_ns))
        return [self._outbox.get_nowait() for _ in range(self._outbox.qsize())]

    def look(self, path: Path, load: Load) -> None:
        """Read the link's state file, and follow the profile in it."""
        try:
            text = read(path, STATE_MAX).decode()
            if text != self._seen:
                self._seen = text
                self.follow(load(from_text(text).profile))
        except TooLongError:  # a long time line: what was asked before holds no more
            self._seen = ""
            self.follow(None)
        except Exception:  # not there yet, half written or nonsense: what was asked holds
            pass

    def _run(self, path: Path | None, load: Load) -> None:
        failed = False
        while self._inbox is not None:
            if path is not None:
                self.look(path, load)
            for _ in range(self._inbox.qsize()):
                records, now_ns = self._inbox.get()
                try:
                    found = self._see(records, now_ns)
                except Exception as error:  # the next look may do better
                    text = f"the monitor of the link failed ({describe_error(error)}); it goes on"
                    found = [] if failed else [Fault(now_ns, "link_check", text)]
                    failed = True
                for record in found:
                    self._outbox.put(record)
            threading.Event().wait(FOLLOW_PERIOD)

    def _see(self, records: Sequence[Record], now_ns: int) -> list[Record]:
        """Take records; every CHECK_NS judge those since the session or the profile settled."""
        for record in records:
            if isinstance(record, Arrival):
                self._fresh |= record.epoch != self._epoch
                self._epoch = record.epoch
                self._arrivals.append(record)
            elif isinstance(record, Lateness):
                self._lates.append(record.lateness + record.busy)
        if self._asked is None:
            return []
        if self._fresh:  # a time line that runs is not judged: its start is not known here
            settled_ns = now_ns + SETTLE_NS
            self._since_ns = settled_ns + Timeline(self._asked).last_ns
            self._due_ns, self._fresh, self._suspects = settled_ns + CHECK_NS, False, set()
        if now_ns < self._since_ns:
            self._forget()
        if now_ns < self._due_ns:
            return []
        self._due_ns = now_ns + CHECK_NS
        return self._report(self._rows(), now_ns)

    def _forget(self) -> None:
        self._arrivals.clear()
        self._lates.clear()

    def _report(self, rows: list[Row], now_ns: int) -> list[Record]:
        """Make records of the rows; a row that is off for the first time is measured again."""
        count, off = len(self._arrivals), {row.name for row in rows if row.verdict == "off"}
        if off - self._suspects:
            rows = [row._replace(verdict="open") if row.name in off else row for row in rows]
            self._forget()
        self._suspects = off
        found: list[Record] = [
            LinkChecked(now_ns, self._uplink, name, asked, measured, low, high, verdict, count)
            for name, _, asked, measured, low, high, verdict in rows
        ]
        before, self._complained = self._complained, verdict_of(rows) == "off"
        if self._complained and not before:
            way = "uplink" if self._uplink else "downlink"
            wrong = ", ".join(describe(row) for row in rows if row.verdict == "off")
            text = f"the {way} is not what was asked for: {wrong}; see 'cloudrc link verify'"
            found.append(Fault(now_ns, "link", text))
        return found

    def _rows(self) -> list[Row]:
        """Judge the datagrams since the session or the profile settled."""
        stream, first, timed = _in_order(self._arrivals)
        if self._plan is None or len(stream.sent) < FEWEST:  # an older verdict holds no more
            return [told("loss", nan)._replace(verdict="open")]
        rows = self._plan.judge(stream, self._epoch, first)
        # The ends' own wake-ups change the distribution.
        skipped = {"distribution"} if timed else {"distribution"} | DELAYS
        return [self._excuse(row) for row in rows if row.name not in skipped]

    def _excuse(self, row: Row) -> Row:
        """Leave a too long delay open if late wakes of this machine's loops may explain it.

        While a loop stalls, datagrams wait for up to its lateness; hence the cubes.
        """
        late = np.array(self._lates or [0.0])
        added = 2.0 * max((late**2).mean(), (late**3).mean() / (3.0 * PERIOD)) ** 0.5
        slow = row.verdict == "off" and row.unit == "s" and row.measured > row.low
        return row._replace(verdict="open") if slow and row.measured <= row.high + added else row


def _in_order(arrivals: Sequence[Arrival]) -> tuple[Stream, int, bool]:
    """Order arrivals by their counters, and mark the missing counters between them as lost.

    Returns also the first counter, and whether the ends share a clock. Without a common clock the
    delays have an unknown offset.
    """
    last = max((one.counter for one in arrivals), default=0) - FINAL
    arrivals = [one for one in arrivals if last - KEPT < one.counter <= last]
    first = arrivals[0].counter if arrivals else last + 1
    arrivals = [one for one in arrivals if one.counter >= first]
    count = last - first + 1
    delays, copies = np.full(count, nan), np.zeros(count, int)
    if not arrivals:
        return Stream(delays, delays, copies), first, False
    begin_ns, timed = arrivals[0].stamp_ns, not any(isnan(one.delay) for one in arrivals)
    numbers, index, times = np.unique(  # the first copy comes first
        [one.counter - first for one in arrivals], return_index=True, return_counts=True
    )
    # A nanosecond apart: what is read in one wake has the same time, but has not lost its order.
    stamps_ns = [one.stamp_ns - begin_ns + place for place, one in enumerate(arrivals)]
    stamps = np.array(stamps_ns)[index] * 1e-9
    known = np.array([one.delay for one in arrivals])[index]
    delays[numbers] = known if timed else stamps - numbers * PERIOD
    copies[numbers] = times
    sent = np.interp(np.arange(count), numbers, stamps - delays[numbers])
    return Stream(sent, delays, copies), first, timed
