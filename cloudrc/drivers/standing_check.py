"""The standing check of an end in flight: records come in; every 5 s a verdict on what it hears.

World hears the downlink, cloud the uplink and the round trips. What a datagram costs is a few sums,
made ten times a second for all that came; what is expected is worked out on a thread of its own
when the link's profile is seen or changes.
"""

from __future__ import annotations

import queue
import threading
import time
from collections import deque
from collections.abc import Callable, Iterable
from functools import partial
from math import isnan
from pathlib import Path

from cloudrc.drivers.standing_basis import Basis, Judged
from cloudrc.drivers.standing_tally import Tally
from cloudrc.errors import in_words
from cloudrc.files import TooLongError, read
from cloudrc.link.profile import DirectionProfile
from cloudrc.link.state import STATE_MAX, from_text
from cloudrc.link.verify_block import Block
from cloudrc.link.verify_judge import Row
from cloudrc.link.verify_standing import RECENT, verdict_of
from cloudrc.link.verify_twin import Stream
from cloudrc.records import Arrival, Control, Fault, Lateness, LinkChecked, Record

PERIOD_NS = 5_000_000_000
"""From one verdict to the next [ns]."""
SUM_PERIOD_NS = 100_000_000
"""How often what has come is added up [ns]: many at once cost a third of each by itself."""
SETTLE_NS = 2_000_000_000
"""After a session began or the link changed, what arrives is not judged for so long [ns]."""
LOOK_PERIOD = 0.5
"""How often it is looked whether the link's profile has changed [s]."""

Asked = tuple[DirectionProfile, DirectionProfile]
"""Of uplink and downlink."""
Load = Callable[[object], Asked]
"""Makes uplink and downlink of the values of a profile's file; raises a CloudrcError."""


class StandingCheck:
    """Judges what one end hears."""

    def __init__(self, *, uplink: bool, stream: Stream) -> None:
        """Set up; nothing is judged before `follow`.

        Args:
            uplink: Whether this end hears the uplink: it is cloud.
            stream: What it hears: whose draws, and how large.
        """
        self._uplink, self._stream = uplink, stream
        self._tally, self._blocks = Tally(), deque[Block]()
        self._basis: Basis | None = None
        self._asked: object = None
        self._held: list[Record] = []
        self._due_ns = self._quiet_ns = self._sum_ns = self._since_ns = 0
        self._settled = False
        self._trip = float("nan")
        self._said = "ok"
        self._failure = ""  # of the thread, in words, until it has been told
        self._jobs: queue.SimpleQueue[Callable[[], None]] | None = None
        self._breathe: Callable[[], None] = lambda: None

    def follow(self, asked: Asked, shaper: str = "") -> None:
        """Judge by this from now on; takes a second, so not on the loop's thread in flight.

        Args:
            asked: Of uplink and downlink.
            shaper: Of what this end sends: "relay" or "netem"; "" if that is not known.
        """
        if asked == self._asked and self._basis is not None:
            self._basis.by_netem = shaper == "netem"
            return
        own, other = asked if self._uplink else reversed(asked)
        basis = Basis(own, other if self._uplink else None, self._stream, self._breathe)
        basis.by_netem = shaper == "netem"
        self._asked, self._basis = asked, basis
        self._tally.place = basis.place
        self._quiet_ns = -1  # set anew by the loop's thread

    def rest(self) -> None:
        """Judge no more until it is known again by what."""
        self._basis = None

    def begin(self, asked: Asked, path: Path | None, load: Load) -> None:
        """Work out on a daemon thread what to judge by.

        Args:
            asked: Of uplink and downlink, until the link itself tells.
            path: State file of the link, which is followed; None if there is none.
            load: Reads the profile in it.
        """
        jobs: queue.SimpleQueue[Callable[[], None]] = queue.SimpleQueue()
        self._jobs, self._breathe = jobs, _breathe
        threading.Thread(
            target=_follow, args=(self, asked, path, load, jobs), name="link check", daemon=True
        ).start()

    def after(self, records: Iterable[Record], now_ns: int) -> list[Record]:
        """Take in what this end has just recorded; say every 5 s what to think of the link.

        Args:
            records: Oldest first.
            now_ns: This end's clock [ns].
        """
        held = self._held
        held += records
        if now_ns < self._sum_ns:
            return []
        self._sum_ns = now_ns + SUM_PERIOD_NS
        if self._quiet_ns < 0:
            self._begin(now_ns)
        for record in held:
            if isinstance(record, Arrival):
                if self._tally.see(record):
                    self._begin(now_ns)
            elif isinstance(record, Lateness):
                self._tally.block.wakes += 1
                late = record.lateness + record.busy
                self._tally.block.lateness += late
                self._tally.block.late_squares += late * late
                self._tally.block.late_cubes += late * late * late
            elif isinstance(record, Control) and self._uplink:
                self._see_trip(record)
        held.clear()
        if now_ns < self._quiet_ns:
            self._tally.forget()
            return []
        return [*self._judge(now_ns), *self._failed(now_ns)] if now_ns >= self._due_ns else []

    def _begin(self, now_ns: int) -> None:
        self._blocks.clear()
        self._tally.forget()
        self._quiet_ns = self._since_ns = now_ns + SETTLE_NS
        self._due_ns = self._quiet_ns + PERIOD_NS
        self._settled = False
        if (basis := self._basis) is not None:
            basis.forget()

    def _see_trip(self, record: Control) -> None:
        trip = record.rtt
        if not isnan(trip) and trip != self._trip:  # a new echo
            self._trip = trip
            self._tally.block.trips += trip
            self._tally.block.trip_count += 1

    def _judge(self, now_ns: int) -> list[Record]:
        self._due_ns = now_ns + PERIOD_NS
        basis, tally = self._basis, self._tally
        if basis is None:
            return []
        self._blocks.append(tally.take())
        changing = now_ns < self._since_ns + basis.changing_ns
        if basis.worth(changing):
            self._compare(basis)
        if not changing and not self._settled:
            self._settled = True
            if basis.changing_ns:  # sums over what has changed say nothing
                self._blocks.clear()
                return []
        rows, count = self._judged(basis, changing)
        if not count:
            return []
        checked: list[Record] = [_record(row, now_ns, self._uplink, count) for row in rows]
        return checked + self._complain(rows, now_ns)

    def _judged(self, basis: Basis, changing: bool) -> Judged:
        """Sum up what is judged together, newest first, and forget what is older."""
        whole, recent, blocks = Block(), Block(), self._blocks
        window = basis.window(timed=any(block.timed for block in blocks))
        for block in reversed(list(blocks)):
            if whole.sent >= window:
                blocks.popleft()
                continue
            whole.add(block)
            if recent.sent < RECENT:
                recent.add(block)
        return basis.judge_changing(whole) if changing else basis.judge(whole, recent)

    def _compare(self, basis: Basis) -> None:
        """Let single datagrams be compared: on a thread of its own, if there is one."""
        tally = self._tally
        job = partial(basis.compare, tally.epoch, list(tally.heard))
        if self._jobs is None:
            job()
        elif self._jobs.empty():
            self._jobs.put(job)

    def _complain(self, rows: list[Row], now_ns: int) -> list[Record]:
        """Say once that the link is not what was asked for."""
        before, self._said = self._said, verdict_of(rows)
        if self._said != "off" or before == "off":
            return []
        way = "uplink" if self._uplink else "downlink"
        wrong = ", ".join(_in_words(row) for row in rows if row.verdict == "off")
        text = f"the {way} is not what was asked for: {wrong}; see 'cloudrc link verify'"
        return [Fault(now_ns, "link", text)]

    def fail(self, error: Exception) -> None:
        """Have it told that single datagrams could not be compared."""
        self._failure = f"the standing check of the link failed ({in_words(error)}); it goes on"

    def _failed(self, now_ns: int) -> list[Record]:
        text, self._failure = self._failure, ""
        return [Fault(now_ns, "link_check", text)] if text else []


def _follow(
    check: StandingCheck,
    asked: Asked,
    path: Path | None,
    load: Load,
    jobs: queue.SimpleQueue[Callable[[], None]],
) -> None:
    """Begin with what is asked; for ever do what is to do, and look whether the profile changes."""
    check.follow(asked)
    seen, failed = "", False
    while True:
        try:
            text = read(path, STATE_MAX).decode() if path is not None else seen
            if text != seen:
                seen = text
                state = from_text(text)
                check.follow(load(state.profile), state.shaper)
        except TooLongError:  # a long time line: what was asked before holds no more
            seen = ""
            check.rest()
        except Exception:  # not there yet, half written or nonsense: what was asked still holds
            pass
        try:
            jobs.get(timeout=LOOK_PERIOD)()
        except queue.Empty:
            pass
        except Exception as error:  # statistics go on judging, and the next job may do better
            if not failed:
                failed = True
                check.fail(error)


def _breathe() -> None:
    """Let the loop's thread run: it waits for the interpreter, which a long look would hold."""
    time.sleep(1e-4)


def _record(row: Row, now_ns: int, uplink: bool, count: int) -> LinkChecked:
    name, _, asked, _, measured, low, high, verdict = row
    return LinkChecked(now_ns, uplink, name, asked, measured, low, high, verdict, count)


def _in_words(row: Row) -> str:
    scale, unit = (1e2, "%") if row.unit == "1" else (1e3, "ms")
    return f"{row.name} {row.measured * scale:.1f} {unit} instead of {row.asked * scale:.1f}"
