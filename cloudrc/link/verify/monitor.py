"""Monitor the link in flight: every 5 s compare what an end receives with what is predicted.

World judges the downlink, cloud the uplink and, if the ends share no clock, round trips. The loop's
thread only hands over its records; a thread of the monitor does the rest.
"""

from __future__ import annotations

import queue
import threading
import time
from collections import deque
from collections.abc import Callable, Sequence
from math import hypot, inf, isinf, isnan, nan
from pathlib import Path
from typing import TypeAlias

import numpy as np

from cloudrc.errors import describe_error
from cloudrc.files import TooLongError, read
from cloudrc.link.model import Stream
from cloudrc.link.profile import DirectionProfile, Timeline, settled
from cloudrc.link.state import STATE_MAX, from_text
from cloudrc.link.verify.causes import describe
from cloudrc.link.verify.judge import (
    FEWEST,
    RUN_LENGTH,
    TAIL,
    Expected,
    Floats,
    Flow,
    Plan,
    Row,
    judge,
    judge_value,
    verdict_of,
)
from cloudrc.records import Arrival, Control, Fault, Lateness, LinkChecked, Record

PERIOD = 0.01
"""Period of telemetry and of commands [s]."""
CHECK_NS, SETTLE_NS = 5_000_000_000, 2_000_000_000
"""Time between two verdicts, and from a new session or profile to the first datagram [ns]."""
KEPT, FINAL = 6000, 128
"""Datagrams that are kept, and newer ones after which a missing one counts as lost [1]."""
ENDS = 2e-3
"""Largest delay that two punctual ends and a tick of the simulation add to a round trip [s]."""
FOLLOW_PERIOD = 0.1
"""Time between two looks at the records and at the state file of the link [s]."""
UNTIMED = ("loss", "reordered", "duplicated")
TIMED = ("mean", "deviation", *UNTIMED)
"""Quantities that are judged without and with a common clock; the ends' own wake-ups change the
shape of the distribution."""

Asked: TypeAlias = tuple[DirectionProfile, DirectionProfile]
"""Profiles of uplink and downlink."""
Load: TypeAlias = Callable[[object], Asked]
"""Reads the values of a profile's file; raises a CloudrcError."""
_Heard: TypeAlias = tuple[int, int, float]  # arrival [ns], counter, one-way delay [s] or NaN


class LinkMonitor:
    """Judge what one end receives, by its records."""

    def __init__(self, *, uplink: bool, flow: Flow) -> None:
        """Set up for the end that receives a flow: cloud the uplink; then call `follow`."""
        self._uplink, self._flow = uplink, flow
        self._arrivals = deque[_Heard](maxlen=KEPT)
        self._trips, self._lates = (deque[float](maxlen=KEPT) for _ in range(2))
        self._asked: Asked | None = None
        self._plans: list[Plan] = []  # of what is received, and of the other direction
        self._epoch, self._trip, self._fresh, self._seen = -1, nan, True, ""
        self._since_ns, self._due_ns = 0.0, 0
        self._suspects, self._complained = set[str](), False
        self._pause: Callable[[], None] = lambda: None
        self._inbox: queue.SimpleQueue[tuple[Sequence[Record], int]] | None = None
        self._outbox = queue.SimpleQueue[Record]()

    def begin(self, asked: Asked, path: Path | None, load: Load) -> None:
        """Start the thread; profiles `asked` hold until the link's state file reports others."""
        self._inbox, self._pause = queue.SimpleQueue(), lambda: time.sleep(1e-4)
        self.follow(asked)
        threading.Thread(target=self._run, args=(path, load), name="link", daemon=True).start()

    def follow(self, asked: Asked | None) -> None:
        """Judge by other profiles from now on; None: by none until they are known."""
        if asked != self._asked:
            self._asked, self._fresh, sent = asked, True, np.arange(float(RUN_LENGTH)) * PERIOD
            ways = () if asked is None else asked if self._uplink else asked[::-1]
            self._plans = [
                Plan(settled(profile), self._flow, sent, pause=self._pause) for profile in ways
            ]

    def after(self, records: Sequence[Record], now_ns: int) -> list[Record]:
        """Take the newest records of this end at `now_ns`; return what to record about the link."""
        if self._inbox is None:
            return self._see(records, now_ns)
        self._inbox.put((records, now_ns))
        return [self._outbox.get_nowait() for _ in range(self._outbox.qsize())]

    def look(self, path: Path, load: Load) -> None:
        """Follow the state file of the link once."""
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
                    told = self._see(records, now_ns)
                except Exception as error:  # the next look may do better
                    text = f"the monitor of the link failed ({describe_error(error)}); it goes on"
                    told = [] if failed else [Fault(now_ns, "link_check", text)]
                    failed = True
                for record in told:
                    self._outbox.put(record)
            threading.Event().wait(FOLLOW_PERIOD)

    def _see(self, records: Sequence[Record], now_ns: int) -> list[Record]:
        """Take records; every CHECK_NS judge those since the session or the profile settled."""
        for record in records:
            if isinstance(record, Arrival):
                self._fresh |= record.epoch != self._epoch
                self._epoch = record.epoch
                self._arrivals.append((record.stamp_ns, record.counter, record.delay))
            elif isinstance(record, Lateness):
                self._lates.append(record.lateness + record.busy)
            elif isinstance(record, Control) and not isnan(record.rtt) and record.rtt != self._trip:
                self._trip = record.rtt
                self._trips.append(record.rtt)
        if self._asked is None:
            return []
        if self._fresh:  # a time line that runs is not judged: where it began is not known here
            last_ns = max(Timeline(profile).last_ns for profile in self._asked)
            settled_ns = now_ns + SETTLE_NS
            self._since_ns, self._due_ns = settled_ns + last_ns, settled_ns + CHECK_NS
            self._fresh, self._suspects = False, set()
        if now_ns < self._since_ns:
            self._forget()
        if now_ns < self._due_ns:
            return []
        self._due_ns = now_ns + CHECK_NS
        return self._report(self._rows(), now_ns)

    def _forget(self) -> None:
        for kept in (self._arrivals, self._trips, self._lates):
            kept.clear()

    def _report(self, rows: list[Row], now_ns: int) -> list[Record]:
        """Make records; look once more at what is off for the first time before saying so."""
        count, off = len(self._arrivals), {row.name for row in rows if row.verdict == "off"}
        if off - self._suspects:
            rows = [row._replace(verdict="open") if row.name in off else row for row in rows]
            self._forget()
        self._suspects = off
        told: list[Record] = [
            LinkChecked(now_ns, self._uplink, name, asked, measured, low, high, verdict, count)
            for name, _, asked, _, measured, low, high, verdict in rows
        ]
        before, self._complained = self._complained, verdict_of(rows) == "off"
        if self._complained and not before:
            way = "uplink" if self._uplink else "downlink"
            wrong = ", ".join(describe(row) for row in rows if row.verdict == "off")
            text = f"the {way} is not what was asked for: {wrong}; see 'cloudrc link verify'"
            told.append(Fault(now_ns, "link", text))
        return told

    def _rows(self) -> list[Row]:
        """Judge by the link's own draws where they fit, otherwise by what netem makes."""
        stream, first, timed = _in_order(list(self._arrivals))
        plan, profile, rows = self._plans[0], self._plans[0].profile, list[Row]()
        told: dict[str, tuple[float, float]] = {"datagrams": (FEWEST, len(stream.sent))}
        if len(stream.sent) >= FEWEST:
            expected = plan.expected(stream, self._epoch, first)
            rows = judge(plan, stream, expected, {})
            if not expected.known:
                told["datagrams"] = (plan.needed(), len(stream.sent))
                told |= {"correlation": (profile.correlation, 0)} if profile.correlation else {}
        rows = [row for row in rows if row.name in (TIMED if timed else UNTIMED)]
        if not timed and len(self._trips) >= FEWEST:
            rows += self._round_trip()
        rows = [_excused(row, np.array(self._lates)) for row in rows]
        if profile.rate:
            told["rate"] = (profile.rate, nan)
        timelines = [Timeline(one) for one in self._asked or ()]
        if any(one.only() is None for one in timelines):  # 1: it loops, and is never judged
            told["time_line"] = (1, float(any(isinf(one.last_ns) for one in timelines)))
        return rows + [
            Row(name, "1", asked, nan, measured, nan, nan, "told")
            for name, (asked, measured) in told.items()
        ]

    def _round_trip(self) -> list[Row]:
        """Judge round trips: the newest wins, so datagrams that none overtook make them."""
        means = np.sum([[_first_come(link) for link in plan.links] for plan in self._plans], axis=0)
        low, high = np.quantile(means, (TAIL, 1.0 - TAIL)).tolist()
        bands = {"round_trip": (float(means.mean()), low, high + ENDS)}
        drawn = Expected(bands, np.zeros(0), known=False)
        return [judge_value("round_trip", drawn, float(np.mean(self._trips)))]


def _in_order(arrivals: Sequence[_Heard]) -> tuple[Stream, int, bool]:
    """Order arrivals by their counters, with the lost ones between them.

    Returns also the first counter and whether the ends share a clock; if not, delays have an
    unknown offset.
    """
    last = max((counter for _, counter, _ in arrivals), default=0) - FINAL
    arrivals = [one for one in arrivals if last - KEPT < one[1] <= last]
    first = arrivals[0][1] if arrivals else last + 1
    arrivals = [one for one in arrivals if one[1] >= first]
    count = last - first + 1
    delays, copies = np.full(count, nan), np.zeros(count, int)
    if not arrivals:
        return Stream(delays, delays, copies), first, False
    begin_ns, timed = arrivals[0][0], not any(isnan(delay) for _, _, delay in arrivals)
    numbers, index, times = np.unique(  # the first copy comes first
        [counter - first for _, counter, _ in arrivals], return_index=True, return_counts=True
    )
    # A nanosecond apart: what is read in one wake has the same time, but has not lost its order.
    stamps_ns = [one[0] - begin_ns + place for place, one in enumerate(arrivals)]
    stamps = np.array(stamps_ns)[index] * 1e-9
    known = np.array([delay for _, _, delay in arrivals])[index]
    delays[numbers] = known if timed else stamps - numbers * PERIOD
    copies[numbers] = times
    sent = np.interp(np.arange(count), numbers, stamps - delays[numbers])
    return Stream(sent, delays, copies), first, timed


def _first_come(stream: Stream) -> float:
    """Return the mean delay [s], without the datagrams that a later one overtook."""
    arrival = np.where(np.isnan(stream.delays), inf, stream.sent + stream.delays)
    first = arrival <= np.minimum.accumulate(arrival[::-1])[::-1]
    return float(stream.delays[first & np.isfinite(arrival)].mean())


def _excused(row: Row, lates: Floats) -> Row:
    """Leave open what ends that wake late may have added; a long stall delays many datagrams."""
    if row.verdict != "off" or not len(lates) or row.measured < row.low or row.unit != "s":
        return row
    waited = 2.0 * max(lates.mean(), (lates**2).mean() / (2.0 * PERIOD))
    square = max((lates**2).mean(), (lates**3).mean() / (3.0 * PERIOD))
    most = hypot(row.high, 2.0 * square**0.5) if row.name == "deviation" else row.high + waited
    return row._replace(verdict="open") if row.measured <= most else row
