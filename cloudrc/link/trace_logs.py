# SPDX-License-Identifier: Apache-2.0

"""Read the delays and losses of real links from logs of ping and irtt, and from CSV files.

    LC_ALL=C ping -D -O HOST
    irtt client -i 10ms -l 204 -d 1m -o irtt.json HOST

Every reader collects the packets of its log, and `packets_of` checks them. An InvalidValueError
says why a log cannot be used. `Packets.notes` counts the packets that are left out or sorted.
docs/traces.md describes the formats.

Source: ping(8) of iputils; irtt-client(1), JSON format 1.
"""

from __future__ import annotations

import json
import re
from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from math import isnan, nan
from typing import Any, Literal

import numpy as np

from cloudrc.base.outside.tables import SECONDS, CsvTable
from cloudrc.base.outside.values import InvalidValueError, Quantity
from cloudrc.link.profile import Trace
from cloudrc.link.streams import Stream

Direction = Literal["uplink", "downlink"]
Entry = tuple[float, float, bool]
"""Time of sending [s], delay [s] (NaN: not known), and whether the packet arrived."""
BACK_MAX = 1.0  # a log whose times go back by this time is refused [s]
LOST = Quantity(ge=0, le=1, whole=True)
"""Mark of a lost packet."""
HALVE = (
    "a trace is one way; if both directions are alike, use half of each round trip with "
    "--halve-rtt; otherwise measure one way with irtt between synchronised clocks"
)


@dataclass(frozen=True, slots=True)
class Packets(Stream):
    """The packets of a log in the order of sending; the times of sending are on any clock."""

    notes: tuple[str, ...] = ()  # texts such as "3 out of order, sorted", for the user
    halved: bool = False  # whether the delays are halves of round trips


def packets_of(
    entries: Sequence[Entry], counts: Counter[str] | None = None, *, halved: bool = False
) -> Packets:
    """Check the packets of a log, sort them by time of sending, and note each correction.

    `counts` tells what was done already, and with how many packets; `halved`, whether the delays
    are halves of round trips. Raise an InvalidValueError if no packet has a delay; if a delay is
    negative; or if the times go far back.
    """
    sent, delays, arrived = np.array(entries or [(nan, nan, False)]).T
    if np.isnan(delays).all():
        raise InvalidValueError("no packet has a delay; give a log with at least one reply")
    refuse_early(float(np.nanmin(delays)))
    back = np.maximum.accumulate(sent) - sent
    if back.max() >= BACK_MAX:  # sorting would mix two sessions
        raise InvalidValueError(
            f"at packet {back.argmax() + 1} the times go back by {back.max():.4g} s: several "
            "sessions in one log, or a step of the clock; give the rows of one session, "
            "sorted by time"
        )
    times, first = np.unique(sent, return_index=True)  # of equal times, the first is kept
    done = dict(counts or {})
    done["out of order, sorted"] = int(np.sum(back > 0.0))
    done["left out, at the time of another one"] = len(sent) - len(times)
    notes = tuple(f"{count} {what}" for what, count in done.items() if count)
    return Packets(times, delays[first], arrived[first].astype(int), notes, halved)


def refuse_early(least: float) -> None:
    """Raise an InvalidValueError if the shortest delay in a log, `least` [s], is negative."""
    if least < 0.0:
        raise InvalidValueError(
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


def read_irtt(text: str, direction: Direction | None, *, halve: bool) -> Packets:
    """Read the output of `irtt client -o FILE.json`.

    The packets that irtt's client sends count as the uplink. A packet that was lost on the way back
    has arrived on the uplink, with an unknown delay. If irtt does not know in which
    direction a packet was lost, the packet counts as lost in both directions. The times of sending
    are on the client's monotonic clock, so steps of the client's wall clock have no effect.

    `halve`: use half of each round trip as one-way delay, and ignore `direction`. Without `halve`,
    `direction` selects the one-way delays to read.

    Raises:
        InvalidValueError: If the file is no output of irtt, or if it has no usable one-way delays
            and `halve` is false.
    """
    try:
        trips = json.loads(text)["round_trips"]
        if not (direction or halve):
            raise InvalidValueError("irtt measures both ways; choose --direction, or --halve-rtt")
        entries = _read_trips(trips, None if halve else direction)
    except InvalidValueError:
        raise
    except _MISSHAPEN as error:
        raise InvalidValueError(
            f"not a log of irtt ({type(error).__name__}: {error}); give the file that 'irtt client "
            "-o FILE.json' writes, with the server's stamps or with --halve-rtt"
        ) from None
    unknown = sum(arrived and isnan(delay) for _, delay, arrived in entries)
    counts = Counter({"lost on the way back, delay unknown": unknown})
    return packets_of(entries, counts, halved=halve)


def _read_trips(trips: list[dict[str, Any]], direction: Direction | None) -> list[Entry]:
    """Read each packet; without a `direction`, half of each round trip.

    The first time is 0.
    On the downlink, packets lost on the uplink are left out. The time is always that of the client,
    even for the downlink: a lost packet has no time of the server.
    """
    stamps = [trip["timestamps"]["client"]["send"] for trip in trips]
    sent_ns = [int(stamp.get("monotonic", stamp.get("wall"))) for stamp in stamps]
    entries = list[Entry]()
    for trip, stamp_ns in zip(trips, sent_ns, strict=True):
        sent, lost, delay = (stamp_ns - sent_ns[0]) * 1e-9, str(trip["lost"]).lower(), nan
        if lost == "false" and direction:
            up, down = int(trip["delay"]["send"]), int(trip["delay"]["receive"])
            refuse_early(min(up, down) * 1e-9)  # of the other direction, too
            delay = (up if direction == "uplink" else down) * 1e-9
        elif lost == "false":
            delay = int(trip["delay"]["rtt"]) * 0.5e-9
        if (direction, lost) != ("downlink", "true_up"):
            arrived = lost == "false" or (direction, lost) == ("uplink", "true_down")
            entries.append((sent, delay, arrived))
    return entries


EXAMPLE = "time_s,delay_ms,lost"
_PERCENT = re.compile("%|pct|percent", re.IGNORECASE)


def read_csv(lines: Iterable[str], name: str, *, halve: bool) -> Packets:
    """Read a CSV log with a header; the notes name columns that are left out.

    A packet counts as lost if its delay is empty or `nan`, or if its column `loss` or `lost`
    contains 1, or `received` contains 0. With `halve`, the log may have round-trip times; half of
    each counts as one-way delay. `name` is the file name for errors about a line.

    Raises:
        BadInputError: If a value cannot be used; the text names line, value and remedy.
        InvalidValueError: If the log cannot be used.
    """
    table = CsvTable(lines, name, EXAMPLE)
    time = table.column(("time", "timestamp", "sent"), SECONDS)
    delay = table.column(("delay", "rtt"), SECONDS)
    halved = delay.name.lower().startswith("rtt")
    if halved and not halve:
        raise InvalidValueError(f"column {delay.name}: has round trips; {HALVE}")
    # Whatever its name: a share of losses must not be passed over in silence.
    losses = table.containing("loss|lost", LOST)
    for column in losses:
        if _PERCENT.search(column.name):
            raise InvalidValueError(
                f"column {column.name}: is a share in percent, but here a row is one packet, lost "
                "or not: give a column lost of 1 and 0; a trace may have shares (docs/traces.md)"
            )
    received = table.find(("received",), {"": 1.0}, LOST)
    scale = delay.scale * (0.5 if halved else 1.0)
    sent, delays = list[float](), list[float]()
    for row in table.rows:
        is_lost = any([row.number(column) for column in losses])
        is_lost |= received is not None and not row.number(received)
        is_lost |= row.cells[delay.at].lower() in ("", "nan")
        sent.append(row.number(time))
        delays.append(nan if is_lost else row.number(delay) * scale)
    # For nanoseconds since 1970 a float has a resolution of 256 ns, which is enough here.
    start = min(sent, default=0.0)
    entries = [
        ((at - start) * time.scale, value, not isnan(value))
        for at, value in zip(sent, delays, strict=True)
    ]
    packets = packets_of(entries, halved=halved)
    others = ", ".join(table.others(time, delay, received, *losses))
    return replace(packets, notes=(*packets.notes, *[f"columns left out: {others}"] * bool(others)))


SESSIONS = "has more than one session of ping; give the lines of one session"
_WRAP = 1 << 16  # after 65535 ping goes on with 0
_REPLY = re.compile(r"\[(\d+\.\d+)\] .*icmp_seq=(\d+) .*time=(\d+(?:\.\d+)?) ms")
"""Line of `ping -D` about a reply: time stamp [s], sequence number, round trip [ms]."""
_NUMBER = re.compile(r"icmp_seq=(\d+)\b")
_SUMMARY = re.compile(r"(\d+) packets transmitted, \d+ received")


def is_ping(lines: list[str]) -> bool:
    """Return whether a text looks like the output of ping."""
    return any(re.search("icmp_seq|^PING |ttl=", line, re.IGNORECASE) for line in lines[:1000])


def read_ping(lines: list[str], *, halve: bool) -> Packets:
    """Read the output of `ping -D` of Linux in English.

    The one-way delay is half of each round trip; `halve` has to permit this. Packets count as lost
    if their sequence number is missing between replies, if a line such as "no answer yet" reports
    them, or if only the summary counts them. Without a summary, packets after the last line are
    ignored.

    Raises:
        InvalidValueError: If `halve` is false; or if the log has another form, no replies or
            several sessions.
    """
    if not halve:
        raise InvalidValueError(f"ping measures round trips; {HALVE}")
    if sum(line.startswith("PING ") for line in lines) > 1:
        raise InvalidValueError(SESSIONS)
    newest, numbers = 0, set[int]()
    sent, trips = dict[int, float](), dict[int, float]()
    for line in lines:
        if not (told := _NUMBER.search(line)) or "DUP!" in line:
            continue
        # A late reply may have a number from before the wrap.
        number = int(told[1])
        number += _WRAP * max(0, round((newest - number) / _WRAP))
        newest = max(newest, number)
        numbers.add(number)
        if reply := _REPLY.match(line):
            if number in trips:
                raise InvalidValueError(SESSIONS)
            trips[number] = float(reply[3]) * 1e-3
            sent[number] = float(reply[1]) - trips[number]
    if not trips:
        raise InvalidValueError(
            "has no replies as Linux' ping -D prints them in English; measure with: LC_ALL=C ping "
            "-D -O HOST; Apple's ping and others have no such lines, so measure with irtt there"
        )
    totals = [int(found[1]) for line in lines if (found := _SUMMARY.search(line))]
    first, last = (1, max(*totals, *numbers)) if totals else (min(numbers), max(numbers))
    n, at = np.array(sorted(sent.items())).T
    period = max(float(np.median(np.diff(at) / np.diff(n))), 1e-6) if len(n) > 1 else 1.0
    # Without a reply, the time of sending is interpolated between its neighbours.
    every = np.arange(first, last + 1)
    outside = np.minimum(every - n[0], 0) + np.maximum(every - n[-1], 0)
    times = (np.interp(every, n, at) + outside * period).tolist()
    entries = [
        (time, trips.get(number, nan) / 2, number in trips)
        for number, time in zip(every.tolist(), times, strict=True)
    ]
    return packets_of(entries, halved=True)
