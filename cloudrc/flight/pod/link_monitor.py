# SPDX-License-Identifier: Apache-2.0

"""Monitor the link in flight: every 5 s, compare the received datagrams with the prediction.

World judges the downlink. Cloud judges the uplink and, if world and cloud share no clock, the round
trips. A separate thread does the work, so that the control loop is not delayed.
"""

from __future__ import annotations

import queue
import threading
import time
from collections import deque
from collections.abc import Callable, Sequence
from math import inf, isnan, nan
from typing import Any, TypeAlias

import numpy as np

from cloudrc.base.errors import CloudrcError
from cloudrc.link.profile import DirectionProfile, LinkSchedule, settled
from cloudrc.link.profile_file import read_keys
from cloudrc.link.start import begin
from cloudrc.link.streams import Stream
from cloudrc.link.traces import link_profile
from cloudrc.link.verify import verdict_of
from cloudrc.link.verify.causes import describe
from cloudrc.link.verify.judge import (
    FEWEST,
    RUN_LENGTH,
    TAIL,
    Expected,
    Flow,
    Judgement,
    Measurement,
    told,
)
from cloudrc.results.metrics.definitions import WINDOW, Echoes
from cloudrc.wire.records import Arrival, Control, Fault, Lateness, LinkChecked, Record

CHECK_NS = 5_000_000_000  # time between two verdicts [ns]
SETTLE_NS = 2_000_000_000  # time after a change in which nothing is judged [ns]
KEPT = 6000  # largest number of datagrams that one verdict uses
ENDS = 2e-3  # largest delay that world and cloud add to a round trip if they wake on time [s]
FOLLOW_PERIOD = 0.1  # period at which the thread reads new records [s]
UNJUDGED = {"distribution"}  # not judged in flight: late wakes of world and cloud change it
DELAYS = {"mean", "deviation"}  # measurable only if world and cloud share a clock

Asked: TypeAlias = tuple[DirectionProfile, DirectionProfile]
"""Requested profiles of uplink and downlink."""


class LinkMonitor:
    """Judges one direction of the link from the records of the program that receives it."""

    def __init__(
        self, uplink: bool, flow: Flow, *, period: float, computes: bool, file_max: int
    ) -> None:
        """Monitor the received `flow`: telemetry in cloud if `uplink`, else commands in world.

        `period` is the time between two datagrams of the flow [s]. `computes` tells whether cloud
        simulates a computing time; delays that contain this time are not judged. `file_max` is the
        size limit of a file that a profile names [bytes].
        """
        self._uplink, self._flow, self._file_max = uplink, flow, file_max
        self._period, self._computes = period, computes
        self._arrivals = deque[Arrival](maxlen=KEPT)
        self._trips, self._lates = (deque[float](maxlen=KEPT) for _ in range(2))
        self._echoes = Echoes()
        self._asked: Asked | None = None
        self._plans: list[Measurement] = []  # for the received flow, and for the other direction
        self._news = deque[dict[str, Any] | None](maxlen=1)  # the newest profile, if not used yet
        self._epoch, self._fresh = -1, True
        self._since_ns, self._due_ns = 0.0, 0
        self._suspects, self._complained = set[str](), False
        self._pause: Callable[[], None] = lambda: None
        self._inbox: queue.SimpleQueue[tuple[Sequence[Record], int]] | None = None
        self._outbox = queue.SimpleQueue[Record]()

    def begin(self, asked: Asked) -> None:
        """Start the thread, which judges the link by the requested profiles `asked`."""
        self._inbox, self._pause = queue.SimpleQueue(), lambda: time.sleep(1e-4)
        self.follow(asked)
        threading.Thread(target=self._run, args=(self._inbox,), name="link", daemon=True).start()

    def request(self, values: dict[str, Any] | None) -> None:
        """Judge the link by a profile with the `values` of its file; None: they are unknown.

        The thread loads the profile later. If it cannot be used, it is unknown.
        """
        self._news.append(values)

    def follow(self, asked: Asked | None) -> None:
        """Set the profiles to judge the link by; None: they are unknown, so judge nothing."""
        if asked != self._asked:
            self._asked, self._fresh = asked, True
            sent = np.arange(float(RUN_LENGTH)) * self._period
            ways = () if asked is None else asked if self._uplink else asked[::-1]
            self._plans = [
                Measurement(settled(profile), self._flow, sent, pause=self._pause)
                for profile in ways
            ]

    def _load(self, values: dict[str, Any] | None) -> Asked | None:
        if values is None:
            return None
        try:
            keys = read_keys(values)
            ways = (
                link_profile(keys.uplink, self._file_max),
                link_profile(keys.downlink, self._file_max),
            )
        except CloudrcError:  # a file is too large, or deleted since
            return None
        uplink, downlink, _ = begin(ways, keys.start_s, 0)
        return uplink, downlink

    def after(self, records: Sequence[Record], now_ns: int) -> list[Record]:
        """Process this end's new records at `now_ns` [ns]; return `LinkChecked`s and `Fault`s."""
        if self._inbox is None:
            return self._see(records, now_ns)
        self._inbox.put((records, now_ns))
        return [self._outbox.get_nowait() for _ in range(self._outbox.qsize())]

    def _run(self, inbox: queue.SimpleQueue[tuple[Sequence[Record], int]]) -> None:
        while True:
            for _ in range(inbox.qsize()):
                for record in self._see(*inbox.get()):
                    self._outbox.put(record)
            threading.Event().wait(FOLLOW_PERIOD)

    def _see(self, records: Sequence[Record], now_ns: int) -> list[Record]:
        """Store records; return new verdicts every `CHECK_NS`, an empty list in between."""
        while self._news:
            self.follow(self._load(self._news.popleft()))
        for record in records:
            self._store(record)
        if self._asked is None:
            return []
        if self._fresh:  # a running schedule is not judged, because its start is not known here
            last_ns = max(LinkSchedule(profile).last_ns for profile in self._asked)
            settled_ns = now_ns + SETTLE_NS
            self._since_ns, self._due_ns = settled_ns + last_ns, settled_ns + CHECK_NS
            self._fresh, self._suspects = False, set()
        if now_ns < self._since_ns:
            self._forget()
        if now_ns < self._due_ns:
            return []
        self._due_ns = now_ns + CHECK_NS
        return self._report(self._rows(), now_ns)

    def _store(self, record: Record) -> None:
        if isinstance(record, Arrival):
            self._fresh |= record.epoch != self._epoch
            self._epoch = record.epoch
            self._arrivals.append(record)
        elif isinstance(record, Lateness):
            self._lates.append(record.lateness + record.busy)
        elif isinstance(record, Control):
            if self._echoes.take(record.rtt, record.loop_delay):
                self._trips.append(record.rtt)

    def _forget(self) -> None:
        for kept in (self._arrivals, self._trips, self._lates):
            kept.clear()

    def _report(self, rows: list[Judgement], now_ns: int) -> list[Record]:
        """Make records of the verdicts; a first "off" becomes "open", a second stays "off"."""
        count, off = len(self._arrivals), {row.name for row in rows if row.verdict == "off"}
        if off - self._suspects:
            rows = [row._replace(verdict="open") if row.name in off else row for row in rows]
            self._forget()
        self._suspects = off
        checked: list[Record] = [LinkChecked(now_ns, self._uplink, *row, count) for row in rows]
        before, self._complained = self._complained, verdict_of(rows) == "off"
        if self._complained and not before:
            way = "uplink" if self._uplink else "downlink"
            wrong = ", ".join(describe(row) for row in rows if row.verdict == "off")
            text = f"the {way} differs from its profile: {wrong}; see 'cloudrc link verify'"
            checked.append(Fault(now_ns, "link", text))
        return checked

    def _rows(self) -> list[Judgement]:
        """Judge all quantities; rows tell of a profile that changes over time, and of a radio.

        Delays are judged only if world and cloud share a clock, and without compute time.
        """
        stream, first, timed = _in_order(self._arrivals, self._period)
        rows, skipped = list[Judgement](), UNJUDGED
        has_radio = any(one.radio for one in self._asked or ())
        if has_radio or not timed or (self._computes and not self._uplink):
            skipped = UNJUDGED | DELAYS
        if len(stream.sent) >= FEWEST:
            rows = self._plans[0].judge(stream, self._epoch, first)
        elif self._arrivals:  # a new session or profile ends the old verdict
            rows = [told("loss", nan)._replace(verdict="open")]
        rows = [row for row in rows if row.name not in skipped]
        if not timed and not self._computes and not has_radio and len(self._trips) >= FEWEST:
            rows.append(self._round_trip())
        rows = [self._excuse(row) for row in rows]
        if any(LinkSchedule(one).only() is None for one in self._asked or ()):
            rows.append(told("time_line", 1))
        if has_radio:  # its phase counts from a time that is not known here
            rows.append(told("radio", 1))
        return rows

    def _round_trip(self) -> Judgement:
        """Judge the mean round trip; datagrams that a later datagram overtook are left out."""
        means = np.sum([[_first_come(link) for link in plan.links] for plan in self._plans], axis=0)
        low, high = np.quantile(means, (TAIL, 1.0 - TAIL)).tolist()
        bands = {"round_trip": (float(means.mean()), low, high + ENDS)}
        expected = Expected(bands, np.zeros(0), known=False)
        return expected.judge("round_trip", float(np.mean(self._trips)))

    def _excuse(self, row: Judgement) -> Judgement:
        """Change a verdict "off" to "open" if late wakes of this machine may explain a long delay.

        If a loop wakes late by t, about t / period datagrams arrive meanwhile. The mean square of
        their waits is t^2 / 3, so the sum of the squares is t^3 / (3 · period). The mean of
        this sum over all wakes is the mean square of the delay that late wakes add.
        """
        late = np.array(self._lates or [0.0])
        added = 2.0 * max((late**2).mean(), (late**3).mean() / (3.0 * self._period)) ** 0.5
        slow = row.verdict == "off" and row.unit == "s" and row.measured > row.low
        return row._replace(verdict="open") if slow and row.measured <= row.high + added else row


def _in_order(arrivals: Sequence[Arrival], period: float) -> tuple[Stream, int, bool]:
    """Sort arrivals by counter, and mark missing counters between them as lost.

    Return the stream, the first counter, and whether world and cloud share a clock. Without a
    shared clock, the delays have an unknown constant offset.
    """
    # Only in this range of counters a missing datagram counts as lost.
    last = max((one.counter for one in arrivals), default=0) - WINDOW
    known = [one for one in arrivals if last - KEPT < one.counter <= last]
    first = known[0].counter if known else last + 1
    arrivals = [one for one in known if one.counter >= first]
    count = last - first + 1
    delays, copies = np.full(count, nan), np.zeros(count, int)
    if not arrivals:
        return Stream(delays, delays, copies), first, False
    begin_ns, timed = arrivals[0].stamp_ns, not any(isnan(one.delay) for one in arrivals)
    numbers, index, times = np.unique(  # the copy that arrived first
        [one.counter - first for one in arrivals], return_index=True, return_counts=True
    )
    # Datagrams read in one wake have the same time: 1 ns apart they keep their order.
    stamps_ns = [one.stamp_ns - begin_ns + place for place, one in enumerate(arrivals)]
    stamps = np.array(stamps_ns)[index] * 1e-9
    measured = np.array([one.delay for one in arrivals])[index]
    delays[numbers] = measured if timed else stamps - numbers * period
    copies[numbers] = times
    sent = np.interp(np.arange(count), numbers, stamps - delays[numbers])
    return Stream(sent, delays, copies), first, timed


def _first_come(stream: Stream) -> float:
    """Return the mean delay of the datagrams that no later datagram overtook [s]."""
    arrival = np.where(np.isnan(stream.delays), inf, stream.sent + stream.delays)
    first = arrival <= np.minimum.accumulate(arrival[::-1])[::-1]
    return float(stream.delays[first & np.isfinite(arrival)].mean())
