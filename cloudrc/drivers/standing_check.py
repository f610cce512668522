"""The standing check of an end in flight: records come in; every 5 s a verdict on what it hears.

World hears the downlink, cloud the uplink and the round trips. What a datagram costs is a few sums;
what is expected is worked out on a thread of its own when the link's profile is seen or changes.
"""

from __future__ import annotations

import threading
import time
from collections import deque
from collections.abc import Callable, Iterable
from math import isnan
from pathlib import Path

from cloudrc.errors import CloudrcError
from cloudrc.exposition.streams import Stream
from cloudrc.link.profile import DirectionProfile
from cloudrc.link.state import from_text
from cloudrc.link.verify_judge import Row
from cloudrc.link.verify_standing import Block, Standing, make_standing, verdict_of
from cloudrc.records import Arrival, Control, Fault, Lateness, LinkChecked, Record
from cloudrc.tunnel.channel import LATE, REPEATED, Channel

PERIOD_NS = 5_000_000_000
"""From one verdict to the next [ns]."""
SETTLE_NS = 2_000_000_000
"""After a session began or the link changed, what arrives is not judged for so long [ns]."""
LOOK_PERIOD = 0.5
"""How often it is looked whether the link's profile has changed [s]."""
_RING = 256

Asked = tuple[DirectionProfile, DirectionProfile]
"""Of uplink and downlink."""
Load = Callable[[object], Asked]
"""Makes uplink and downlink of the values of a profile's file; raises a CloudrcError."""


class Tally:
    """Sums over what arrives in one direction."""

    def __init__(self) -> None:
        """Begin before the first datagram."""
        self.block = Block()
        self._channel = Channel(newest_wins=True)
        self._stream = Stream()
        self._told = (0, 0)
        self._epoch = -1
        self._delays: list[tuple[int, float]] = [(-1, 0.0)] * _RING

    def see(self, arrival: Arrival) -> bool:
        """Add one datagram; True if it is the first of its session."""
        _, _, epoch, counter, delay, _ = arrival
        self._stream.take(epoch, counter)
        if epoch != self._epoch:
            self._epoch = epoch
            self._channel.reset()
            self._channel.take(counter)
            return True
        block, outcome = self.block, self._channel.take(counter)
        if outcome == REPEATED:
            block.copies += 1
            return False
        block.arrived += 1
        if outcome == LATE:
            block.late += 1
        if delay == delay:  # not NaN
            self._add_delay(counter, delay)
        return False

    def _add_delay(self, counter: int, delay: float) -> None:
        block, delays = self.block, self._delays
        block.timed += 1
        block.delays += delay
        block.squares += delay * delay
        delays[counter % _RING] = (counter, delay)
        for neighbour in (counter - 1, counter + 1):
            known, other = delays[neighbour % _RING]
            if known == neighbour:
                block.steps += abs(delay - other)
                block.pairs += 1

    def take(self) -> Block:
        """Hand over the sums and begin new ones."""
        block, self.block = self.block, Block()
        (sent, lost), self._told = self._told, (self._stream.expected, self._stream.lost)
        block.sent, block.lost = self._told[0] - sent, self._told[1] - lost
        return block


class StandingCheck:
    """Judges what one end hears."""

    def __init__(self, *, uplink: bool, size: int) -> None:
        """Set up; nothing is judged before `follow`.

        Args:
            uplink: Whether this end hears the uplink: it is cloud.
            size: Of the datagrams that it hears, UDP payload [bytes].
        """
        self._uplink, self._size = uplink, size
        self._tally, self._blocks = Tally(), deque[Block]()
        self._standing: Standing | None = None
        self._asked: object = None
        self._due_ns = self._quiet_ns = 0
        self._trip = float("nan")
        self._said = "ok"

    def follow(self, asked: Asked) -> None:
        """Judge by this from now on; takes some 50 ms, so not on the loop's thread in flight."""
        if asked == self._asked:
            return
        own, other = asked if self._uplink else reversed(asked)
        standing = make_standing(own, self._size, other if self._uplink else None)
        self._asked, self._standing = asked, standing
        self._quiet_ns = -1  # set anew by the loop's thread

    def begin(self, asked: Asked, path: Path | None, load: Load) -> None:
        """Work out on a daemon thread what to judge by.

        Args:
            asked: Of uplink and downlink, until the link itself tells.
            path: State file of the link, which is followed; None if there is none.
            load: Reads the profile in it.
        """
        threading.Thread(
            target=_follow, args=(self, asked, path, load), name="link check", daemon=True
        ).start()

    def after(self, records: Iterable[Record], now_ns: int) -> list[Record]:
        """Take in what this end has just recorded; say every 5 s what to think of the link.

        Args:
            records: Oldest first.
            now_ns: This end's clock [ns].
        """
        if self._quiet_ns < 0:
            self._begin(now_ns)
        for record in records:
            if isinstance(record, Arrival):
                if self._tally.see(record):
                    self._begin(now_ns)
            elif isinstance(record, Control) and self._uplink:
                self._see_trip(record)
            elif isinstance(record, Lateness):
                self._tally.block.lateness += record.lateness + record.busy
                self._tally.block.wakes += 1
        if now_ns < self._quiet_ns:
            self._tally.take()
            return []
        return self._judge(now_ns) if now_ns >= self._due_ns else []

    def _begin(self, now_ns: int) -> None:
        self._blocks.clear()
        self._tally.take()
        self._quiet_ns = now_ns + SETTLE_NS
        self._due_ns = self._quiet_ns + PERIOD_NS

    def _see_trip(self, record: Control) -> None:
        trip = record.rtt
        if not isnan(trip) and trip != self._trip:  # a new echo
            self._trip = trip
            self._tally.block.trips += trip
            self._tally.block.trip_count += 1

    def _judge(self, now_ns: int) -> list[Record]:
        self._due_ns = now_ns + PERIOD_NS
        self._blocks.append(self._tally.take())
        standing, whole = self._standing, Block()
        if standing is None:
            return []
        for block in reversed(list(self._blocks)):
            if whole.sent >= standing.window:
                self._blocks.popleft()
            else:
                whole.add(block)
        if not whole.sent:
            return []
        rows = standing.rows(whole)
        checked: list[Record] = [_record(row, now_ns, self._uplink, whole.sent) for row in rows]
        return checked + self._complain(rows, now_ns)

    def _complain(self, rows: list[Row], now_ns: int) -> list[Record]:
        """Say once that the link is not what was asked for."""
        before, self._said = self._said, verdict_of(rows)
        if self._said != "off" or before == "off":
            return []
        way = "uplink" if self._uplink else "downlink"
        wrong = ", ".join(_in_words(row) for row in rows if row.verdict == "off")
        text = f"the {way} is not what was asked for: {wrong}; see 'cloudrc link verify'"
        return [Fault(now_ns, "link", text)]


def _follow(check: StandingCheck, asked: Asked, path: Path | None, load: Load) -> None:
    """Begin with what is asked; look for ever whether the profile in the link's state changes."""
    check.follow(asked)
    seen = ""
    while path is not None:
        try:
            text = path.read_text(encoding="utf-8")
            if text != seen:
                seen = text
                check.follow(load(from_text(text).profile))
        except (OSError, ValueError, CloudrcError):
            pass  # not there yet, or half written: what was asked before still holds
        time.sleep(LOOK_PERIOD)


def _record(row: Row, now_ns: int, uplink: bool, count: int) -> LinkChecked:
    name, _, asked, _, measured, low, high, verdict = row
    return LinkChecked(now_ns, uplink, name, asked, measured, low, high, verdict, count)


def _in_words(row: Row) -> str:
    scale, unit = (1e2, "%") if row.name in ("loss", "reordered", "duplicated") else (1e3, "ms")
    return f"{row.name} {row.measured * scale:.1f} {unit} instead of {row.asked * scale:.1f}"
