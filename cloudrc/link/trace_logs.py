"""Read the delays and losses of real links from logs of ping and irtt, and from CSV files.

    LC_ALL=C ping -D -O HOST
    irtt client -i 10ms -l 204 -d 1m -o irtt.json HOST

Every reader fills a `Log` with packets, and `Log.packets` checks them. `Packets.notes` counts the
packets that are left out or sorted. docs/traces.md describes the formats.

Source: ping(8) of iputils; irtt-client(1), JSON format 1.
"""

from __future__ import annotations

import json
import re
from collections import Counter
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field
from math import nan
from typing import Any, Literal, TypeAlias

import numpy as np

from cloudrc.errors import BadInputError
from cloudrc.link.profile import Trace
from cloudrc.link.streams import Stream
from cloudrc.link.traces import Row, read_rows

Direction: TypeAlias = Literal["uplink", "downlink"]
Entry: TypeAlias = tuple[float, float]
"""Time of sending [s] and delay [s]; the delay is NaN if the packet was lost."""
REPEATED_MAX = 0.01  # largest share of packets with the time of an earlier one, in [0, 1]
BACK_MAX = 1.0  # a log whose times go back by this time is refused [s]
HALVE = (
    "a trace is one way; if both directions are alike, use half of each round trip with "
    "--halve-rtt; otherwise measure one way with irtt between synchronised clocks"
)


@dataclass(frozen=True, slots=True)
class Packets(Stream):
    """The packets of a log in the order of sending; the times of sending are on any clock."""

    notes: tuple[str, ...] = ()  # texts such as "3 out of order, sorted", for the user
    halved: bool = False  # whether the delays are halves of round trips


@dataclass(slots=True)
class Log:
    """The packets that a reader finds in a log, and the number of those that it left out."""

    name: str
    entries: list[Entry] = field(default_factory=list)  # the packets in the order of the log
    counts: Counter[str] = field(default_factory=Counter)  # what was done -> number of packets
    halved: bool = False  # whether the delays are halves of round trips
    unmeasured: set[float] = field(default_factory=set)
    """Times of sending [s] of packets that arrived with an unknown delay, NaN in `entries`."""

    def packets(self) -> Packets:
        """Check the packets, sort them by time of sending, and add a note on each correction.

        Raise a BadInputError if no packet has a delay; if a delay is negative; if the times go far
        back; or if more than 1 % of the packets have the time of an earlier packet.
        """
        times, delays = np.array(self.entries or [(nan, nan)]).T
        if np.isnan(delays).all():
            raise self.error("no packet has a delay; give a log with at least one reply")
        self.refuse_early(float(np.nanmin(delays)))
        back = np.maximum.accumulate(times) - times
        if back.max() >= BACK_MAX:  # sorting would mix two sessions
            raise self.error(
                f"at packet {back.argmax() + 1} the times go back by {back.max():.4g} s: several "
                "sessions in one log, or a step of the clock; give the rows of one session, "
                "sorted by time"
            )
        unique = dict(reversed(self.entries))  # of packets with the same time, the first is kept
        repeated = len(times) - len(unique)
        if repeated > REPEATED_MAX * len(times):
            same = f"{repeated} of {len(times)} packets have the same time as another one"
            raise self.error(f"{same}; give times with more digits")
        self.counts["out of order, sorted"] += int(np.sum(back > 0.0))
        self.counts["left out, at the time of another one"] += repeated
        notes = tuple(f"{count} {what}" for what, count in self.counts.items() if count)
        sent, delays = np.array(sorted(unique.items())).T
        copies = (np.isfinite(delays) | np.isin(sent, [*self.unmeasured])).astype(int)
        return Packets(sent, delays, copies, notes, self.halved)

    def error(self, text: str) -> BadInputError:
        """Make an error that begins with the name of the log."""
        return BadInputError(f"{self.name}: {text}")

    def refuse_early(self, least: float) -> None:
        """Raise a BadInputError if the shortest delay in the log, `least` [s], is negative."""
        if least < 0.0:
            raise self.error(
                f"a packet arrived {-least * 1e3:.4g} ms before it was sent: the two clocks differ;"
                " synchronise them, or use round trips and take half of each (--halve-rtt);"
                " leave the delay of a lost packet empty"
            )


def trace_of(packets: Packets) -> Trace:
    """Make a trace that repeats the delays and losses of a log at the log's packet rate.

    Each row applies from half a period before its packet was sent until half a period after. So in
    a flight a packet that is a little early or late gets the right row. Time 0 is the first packet.
    A packet without a known delay has the delay of the packet before it.
    """
    sent, unknown, lost = packets.sent, np.isnan(packets.delays), packets.copies == 0
    halfway = (sent[1:] + sent[:-1]) / 2 - sent[0]
    newest = np.maximum.accumulate(np.where(unknown, 0, np.arange(len(unknown))))
    delays = packets.delays[np.maximum(newest, np.argmin(unknown))]
    losses = tuple(lost.astype(float).tolist()) if lost.any() else None
    return Trace((0.0, *halfway.tolist()), tuple(delays.tolist()), losses)


_MISSHAPEN = ArithmeticError, AttributeError, LookupError, RecursionError, TypeError, ValueError
"""Errors that reading JSON with an unexpected layout can raise."""
_IRTT_KEYS = {None: "rtt", "uplink": "send", "downlink": "receive"}
"""Direction, None for round trips -> irtt's key of the delay."""


def read_irtt(text: str, name: str, direction: Direction | None, *, halve: bool) -> Packets:
    """Read the output of `irtt client -o FILE.json`.

    The packets that irtt's client sends count as the uplink. A packet that was lost on the way back
    has arrived on the uplink, with an unknown delay. If irtt does not know in which
    direction a packet was lost, the packet counts as lost in both directions. The times of sending
    are on the client's monotonic clock, so steps of the client's wall clock have no effect.

    `halve`: use half of each round trip as one-way delay, and ignore `direction`. Without `halve`,
    `direction` selects the one-way delays to read. `name` is the file name for messages.

    Raises:
        BadInputError: If the file is no output of irtt, or if it has no usable one-way delays and
            `halve` is false.
    """
    log = Log(name, halved=halve)
    try:
        trips = json.loads(text)["round_trips"]
        if direction is None and not halve:
            raise log.error(
                "irtt measures both directions; choose --direction uplink (sent by its client) or "
                "downlink"
            )
        _read_trips(trips, None if halve else direction, log)
    except _MISSHAPEN as error:
        raise log.error(
            f"not a log of irtt ({type(error).__name__}: {error}); give the file that 'irtt client "
            "-o FILE.json' writes"
        ) from None
    return log.packets()


def _read_trips(trips: list[dict[str, Any]], direction: Direction | None, log: Log) -> None:
    """Read the time of sending and the delay of each packet [s] into `log`; the first time is 0.

    On the downlink, packets lost on the uplink are left out. The time is always that of the client,
    even for the downlink: a lost packet has no time of the server.
    """
    arrived = [trip["delay"] for trip in trips if _fate(trip) == "false"]
    if direction:
        if any(not {"send", "receive"} <= delay.keys() for delay in arrived):
            raise log.error(f"irtt's server sent no stamps: has round trips; {HALVE}")
        both = [int(delay[key]) for delay in arrived for key in ("send", "receive")]
        log.refuse_early(min(both, default=0) * 1e-9)  # of the other direction, too
    stamps = [trip["timestamps"]["client"]["send"] for trip in trips]
    sent_ns = [int(stamp.get("monotonic", stamp.get("wall"))) for stamp in stamps]
    for trip, stamp_ns in zip(trips, sent_ns, strict=True):
        sent, fate, delay = (stamp_ns - sent_ns[0]) * 1e-9, _fate(trip), nan
        if (direction, fate) == ("downlink", "true_up"):
            continue
        if fate == "false":
            delay = int(trip["delay"][_IRTT_KEYS[direction]]) * (1e-9 if direction else 0.5e-9)
        log.entries.append((sent, delay))
        if (direction, fate) == ("uplink", "true_down"):
            log.unmeasured.add(sent)
            log.counts["lost on the way back, delay unknown"] += 1


def _fate(trip: dict[str, Any]) -> str:
    """Return whether a packet was lost: "false", "true", "true_up" or "true_down"."""
    return str(trip["lost"]).lower()


SCALES = {"s": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9}
TIMES, DELAYS, LOSSES = ("time", "timestamp", "sent"), ("delay", "rtt"), ("loss", "lost")
COLUMNS = "time_s and delay_ms, or with _s, _ms, _us or _ns; rtt_ for round trips; and loss"


def read_csv(lines: Iterable[str], name: str, *, halve: bool) -> Packets:
    """Read a CSV log with a header; unknown columns are skipped.

    A packet counts as lost if its delay is empty or `nan`, or if its column `loss` contains 1. With
    `halve`, the log may have round-trip times; half of each counts as one-way delay. `name` is the
    file name for messages.

    Raises:
        BadInputError: If the log cannot be used; the text names line, value and remedy.
    """
    columns, rows = read_rows(lines, name)
    time, time_unit = _find(columns, TIMES, name)
    delay, unit = _find(columns, DELAYS, name)
    log = Log(name, halved=delay.startswith("rtt"))
    if log.halved and not halve:
        raise BadInputError(f"{name}, column {delay}: has round trips; {HALVE}")
    # A share of losses must not be passed over in silence.
    losses = [column for column in columns if any(word in column for word in LOSSES)]
    if {*losses} - {*LOSSES}:
        raise log.error(f"column {losses[0]} is not read; call it loss, 0 or 1, or remove it")
    raw = [(row.number(time), _csv_delay(row, delay, losses)) for row in rows]
    # For nanoseconds since 1970 a float has a resolution of 256 ns, which is enough here.
    start = min((sent for sent, _ in raw), default=0.0)
    scales = SCALES[time_unit], SCALES[unit] * (0.5 if log.halved else 1.0)
    log.entries = [((sent - start) * scales[0], value * scales[1]) for sent, value in raw]
    return log.packets()


def _find(columns: list[str], kinds: tuple[str, ...], name: str) -> tuple[str, str]:
    """Return the only column named after one of `kinds` and a unit, as `delay_ms`, and the unit.

    Raise an error if there is none, or more than one; `name` is the log's name, for the error.
    """
    pattern = re.compile(f"(?:{'|'.join(kinds)})_({'|'.join(SCALES)})")
    found = [(column, it[1]) for column in columns if (it := pattern.fullmatch(column))]
    if len(found) != 1:
        raise BadInputError(
            f"{name}: has {len(found)} columns {kinds[0]} in {','.join(columns)[:200]!r}; name them"
            f" {COLUMNS}"
        )
    return found[0]


def _csv_delay(row: Row, column: str, losses: list[str]) -> float:
    """Read the delay of a packet from `column`, in the column's unit; return NaN for a lost packet.

    `losses` are the columns that mark lost packets with 1 or "true".
    """
    lost = [row.cells[name].lower() not in ("0", "false") for name in losses]
    if any(lost) or row.cells[column].lower() in ("", "nan"):
        return nan
    return row.number(column)


_WRAP = 1 << 16  # after 65535 ping goes on with 0
_PACKET = re.compile(r"(?:\[(\d+\.\d+)\] )?.*icmp_seq=(\d{1,5})\b(?: .*time=(\d+(?:\.\d+)?) ms)?")
"""Line of `ping -D` about a packet: time stamp [s], sequence number, round trip [ms]."""
_SUMMARY = re.compile(r"(\d+) packets transmitted, \d+ received")
_NO_LINUX = (
    "is not what Linux' ping -D prints in English; measure with: LC_ALL=C ping -D -O HOST; Apple's "
    "ping and others have no such lines, so measure with irtt there"
)


def is_ping(lines: list[str]) -> bool:
    """Return whether a text looks like the output of ping."""
    signs = re.compile(r"icmp_seq|\bPING |\b(ttl|TTL)=")
    return any(signs.search(line) for line in lines[:1000])


def read_ping(lines: list[str], name: str, *, halve: bool) -> Packets:
    """Read the output of `ping -D` of Linux in English.

    The one-way delay is half of each round trip; `halve` has to permit this. Packets count as lost
    if their sequence number is missing between replies, if a line such as "no answer yet" reports
    them, or if only the summary counts them. Without a summary, packets after the last line are
    ignored.

    Raises:
        BadInputError: If `halve` is false; or if the log `name` has another form, no replies or
            several sessions.
    """
    log = Log(name, halved=True)
    if not halve:
        raise log.error(f"ping measures round trips; {HALVE}")
    totals = [int(found[1]) for line in lines if (found := _SUMMARY.search(line))]
    is_twice = max(len(totals), sum(line.startswith("PING ") for line in lines)) > 1
    sent, trips, numbers = dict[int, float](), dict[int, float](), set[int]()
    for number, stamp, trip, line in _ping_packets(lines, log):
        numbers.add(number)
        if trip is not None:
            is_twice |= number in trips
            sent[number], trips[number] = stamp - trip, trip
        elif stamp and "no answer yet" in line:  # said just before ping sends the next packet
            sent.setdefault(number + 1, stamp)
    if is_twice:
        raise log.error("has more than one session of ping; give the lines of one session")
    if not trips:
        raise log.error(f"has no replies, or {_NO_LINUX}")
    order = np.array(list(trips))
    log.counts["out of order, sorted"] += int(np.sum(order < np.maximum.accumulate(order)))
    first, last = (1, max(*totals, *numbers)) if totals else (min(numbers), max(numbers))
    n, at = np.array(sorted(sent.items())).T
    period = max(float(np.median(np.diff(at) / np.diff(n))), 1e-6) if len(n) > 1 else 1.0
    # Without a reply, the time of sending is interpolated between its neighbours.
    every = np.arange(first, last + 1)
    outside = np.minimum(every - n[0], 0) + np.maximum(every - n[-1], 0)
    sends = np.interp(every, n, at) + outside * period
    halves = (trips.get(number, nan) / 2 for number in every.tolist())
    log.entries = list(zip(sends.tolist(), halves, strict=True))
    return log.packets()


def _ping_packets(lines: list[str], log: Log) -> Iterator[tuple[int, float, float | None, str]]:
    """Yield number, time stamp [s], round trip [s] and line of each packet; 0 without a stamp.

    The round trip is None for a packet without a reply.
    """
    newest = 0
    for line in lines:
        found = _PACKET.match(line)
        is_other = "ttl=" in line and not (found and found[1] and found[3])
        if is_other or " data bytes" in line:
            raise log.error(f"{line[:80]!r} {_NO_LINUX}")
        if found is None:
            continue
        if "DUP!" in line:
            log.counts["duplicates left out"] += 1
            continue
        # A late reply may have a number from before the wrap.
        number = int(found[2])
        number += _WRAP * max(0, round((newest - number) / _WRAP))
        newest = max(newest, number)
        yield number, float(found[1] or 0.0), float(found[3]) * 1e-3 if found[3] else None, line
