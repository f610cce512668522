"""Read logs of ping and fping: `ping -D -O HOST`, `ping --apple-time HOST`, in any language.

A log has the arrival times of replies and their round trips. These packets count as lost: sequence
numbers that are missing between replies, packets with a line such as "no answer yet", and packets
that only the summary counts. Without a summary, packets after the last line are unknown, because
their replies may have been under way.

Source: ping(8) of iputils, macOS and BusyBox; fping(8).
"""

from __future__ import annotations

import re
from dataclasses import dataclass, field
from datetime import datetime
from itertools import pairwise
from statistics import fmean, median

from cloudrc.errors import BadInputError
from cloudrc.link.logs import HALVE, Log, Packets

PACKETS_MAX = 10_000_000
"""Limit of packets in a log, because a number may be forged: three weeks at five packets a
second."""
STEP_BACK = 0.02
"""Limit of the time [s] by which a packet may seem to be sent before the packet with the number
before its own."""
_WRAP = 1 << 16
_STAMP = re.compile(
    r"\[?(?P<unix>(?<=\[)\d+(?:\.\d+)?|\d{9,10}\.\d+)\]? +"
    r"|(?P<date>\d{4}-\d\d-\d\d)?[T ]?(?P<hour>\d\d):(?P<minute>\d\d):(?P<second>\d\d\.\d+)\S* +"
)
"""Time stamp of a line: from `ping -D`, `ts '[%.s]'` or `ping --apple-time`, or date and time."""
_NUMBER = re.compile(r"\b(?:icmp6?_)?(?:seq|req)[= ](\d{1,12})\b|(?<= : )\[(\d{1,12})\], ")
_ROUND_TRIP = re.compile(r"(?:[=<] ?|, )(\d+(?:[.,]\d+)?) ?(?:ms|msec|msek|мс|毫秒|ミリ秒)(?=\W|$)")
_REPLY = re.compile(r"ttl=|hlim=|bytes from", re.IGNORECASE)
_SUMMARY = re.compile(r"xmt/rcv/%loss = (\d+)/(\d+)/|^(?!.*xmt/)\D*(\d+)\D+(\d+)\D.*%")
"""Summary at the end: packets sent, packets received."""
_MEAN = re.compile(r"min/avg/\S+ = [\d.]+/([\d.]+)/")
_NO_STAMPS = {
    r"(?<!_)\bseq=\d": "BusyBox's ping gives no times: ping HOST | ts '[%.s]', or use irtt",
    r"\d data bytes|Request timeout": (
        "on macOS -D forbids fragments: use ping --apple-time there; BSD: ping HOST | ts '[%.s]'"
    ),
    r"\], \d+ bytes": "run fping with -D",
    "": "run ping with -D",
}
"""Pattern in a log without time stamps -> remedy for this kind of ping; the first match counts."""


@dataclass(slots=True)
class _Found:
    """Content of the lines of a log. A number is a packet's sequence number.

    Attributes:
        replies: Number -> time of sending and round trip [s].
        told: Number -> time stamp of the line about the packet, 0 without a time stamp [s].
        trips: All round trips, including those of duplicates [s].
        summaries: Packets sent and received, one pair per summary.
        headers: Number of lines that begin a log.
        base: First number that this kind of ping sends.
    """

    replies: dict[int, tuple[float, float]] = field(default_factory=dict)
    told: dict[int, float] = field(default_factory=dict)
    trips: list[float] = field(default_factory=list)
    summaries: list[tuple[int, int]] = field(default_factory=list)
    headers: int = 0
    base: int = 1


def is_ping(lines: list[str]) -> bool:
    """Return whether a text looks like the output of ping."""
    return any(_NUMBER.search(line) or line.startswith("PING ") for line in lines[:1000])


def read_ping(lines: list[str], name: str, *, halve: bool) -> Packets:
    """Read the output of `ping -D` or of a similar program.

    Args:
        lines: Lines of the log.
        name: Name of the file, for messages.
        halve: Must be true: the user accepts half of each round trip as the one-way delay.

    Returns:
        Packets; their delays are halves of the round trips.

    Raises:
        BadInputError: If `halve` is false, if the log has no replies, no time stamps, too many
            packets or several sessions, or if it contradicts its summary.
    """
    if not halve:
        raise BadInputError(f"{name}: ping measures round trips; {HALVE}")
    log = Log(name, halved=True)
    found = _read_lines(lines, log)
    replies = found.replies
    if not replies and log.unusable:
        raise BadInputError(log.unusable[0])
    if not replies:
        raise BadInputError(f"{name}: has no replies; give the output of: ping -D -O HOST")
    first, last = _range(found, name)
    period = _check_clock(found, log)
    known = sorted(replies)
    for before, after in pairwise([None, *known, None]):
        # Without a reply, the time of sending lies on a straight line between the replies around.
        step, start = period, 0.0
        if before is not None and after is not None:
            step = (replies[after][0] - replies[before][0]) / (after - before)
        if (anchor := after if before is None else before) is not None:
            start = replies[anchor][0] - anchor * step
        low = first if before is None else before + 1
        high = last + 1 if after is None else after
        log.entries += [(start + number * step, None) for number in range(low, high)]
        if after is not None:
            log.entries.append((replies[after][0], replies[after][1] / 2))
    return log.packets()


def _read_lines(lines: list[str], log: Log) -> _Found:
    """Read the lines of a log; unwrap ping's 16-bit sequence numbers."""
    found = _Found()
    wraps, newest, day, last_stamp = 0, 0, 0.0, 0.0
    for line in lines:
        number = _NUMBER.search(line)
        if number is None:
            _read_other(line, found, log)
            continue
        trip, stamp = _ROUND_TRIP.search(line), _STAMP.match(line)
        if trip is None and _REPLY.search(line):
            reason = f"a reply without a time that can be read: {line.strip()[:60]!r}"
            log.unusable.append(f"{log.name}: {reason}; run: LC_ALL=C ping -D -O HOST")
            continue
        round_trip = float(trip[1].replace(",", ".")) * 1e-3 if trip else 0.0
        if trip and stamp is None:
            text = "\n".join(lines[:1000])
            remedy = next(words for kind, words in _NO_STAMPS.items() if re.search(kind, text))
            raise BadInputError(f"{log.name}: its lines have no [time]; {remedy}")
        if trip:
            found.trips.append(round_trip)
        if "DUP!" in line:
            log.counts["duplicates left out"] += 1
            continue
        # After 65535 ping continues with 0; a late reply may be from before that.
        count = int(number[1] or number[2]) + wraps * _WRAP
        if newest - count > _WRAP // 2:
            wraps, count = wraps + 1, count + _WRAP
        elif count - newest > _WRAP // 2 and wraps:
            count -= _WRAP
        log.counts["out of order, sorted"] += bool(trip) and count < newest
        newest = max(newest, count)
        at = 0.0
        if stamp is not None:
            at = _seconds(stamp) + day
            if not stamp["unix"] and not stamp["date"] and last_stamp - at > 43_200:
                at, day = at + 86_400.0, day + 86_400.0  # midnight
            last_stamp = at
        if trip and count in found.replies:
            _refuse_sessions(log.name, f"number {count} comes twice")
        if trip:
            found.replies[count] = at - round_trip, round_trip
        found.told[count] = at
        if count == 0 or number[2]:
            found.base = 0
    return found


def _read_other(line: str, found: _Found, log: Log) -> None:
    """Read a line without a sequence number: header, summary, or another line."""
    summary, mean = _SUMMARY.search(line), _MEAN.search(line)
    if line.startswith(("PING ", "PING6(")):
        found.headers += 1
        found.base = 0 if " data bytes" in line else found.base
    elif mean is not None:
        told, read = float(mean[1]), fmean(found.trips or [0.0]) * 1e3
        if abs(told - read) > 0.1 + 0.01 * told:
            raise BadInputError(
                f"{log.name}: its summary gives a mean of {told:g} ms, but its replies have "
                f"{read:.4g} ms; give the whole log as ping wrote it"
            )
    if summary is not None:
        sent, received = (int(word) for word in summary.groups() if word)
        found.summaries.append((sent, received))
    elif line.strip() and mean is None and not line.startswith(("PING", "---")):
        log.counts["other lines left out"] += 1


def _seconds(stamp: re.Match[str]) -> float:
    """Convert the time stamp of a line to the time since 1970 or since midnight [s]."""
    if stamp["unix"]:
        return float(stamp["unix"])
    day = datetime.fromisoformat((stamp["date"] or "1970-01-01") + "T00:00:00+00:00").timestamp()
    return day + int(stamp["hour"]) * 3600 + int(stamp["minute"]) * 60 + float(stamp["second"])


def _range(found: _Found, name: str) -> tuple[int, int]:
    """Return the first and the last sequence number; compare the log with its own summary."""
    beginnings = max(found.headers, len(found.summaries))
    if beginnings > 1:
        _refuse_sessions(name, f"{beginnings} beginnings or ends")
    first, last = min(found.told), max(found.told)
    if found.summaries:
        sent, received = found.summaries[0]
        if received != len(found.replies) or sent < last - found.base + 1:
            raise BadInputError(
                f"{name}: its summary counts {sent} sent and {received} received, but it has "
                f"{len(found.replies)} replies up to number {last}; give the whole log"
            )
        first, last = found.base, found.base + sent - 1
    if last - first >= PACKETS_MAX:
        raise BadInputError(
            f"{name}: its sequence numbers span {last - first + 1} packets, more than "
            f"{PACKETS_MAX}; give the output of one ping"
        )
    return first, last


def _refuse_sessions(name: str, sign: str) -> None:
    raise BadInputError(
        f"{name}: has more than one session of ping ({sign}); give the lines of one session"
    )


def _check_clock(found: _Found, log: Log) -> float:
    """Check the times of sending by the numbers; return the median time between packets [s]."""
    sent = {number: at for number, (at, _) in sorted(found.replies.items())}
    times = sent if len(sent) > 1 else {n: at for n, at in sorted(found.told.items()) if at}
    pairs = list(pairwise(times.items()))
    period = median([(b - a) / (m - n) for (n, a), (m, b) in pairs] or [1.0])
    for (before, at), (after, later) in pairwise(sent.items()):
        step, usual = later - at - (after - before) * period, (after - before) * period
        if later - at < -STEP_BACK or step < -max(2.0, 5 * period):
            raise BadInputError(
                f"{log.name}: after number {before} the times go back by {-step:.3g} s: a step of "
                "the clock, or two sessions in one log; give the lines before or after it"
            )
        if step > max(2.0, 5 * period, 0.2 * usual):
            log.facts.append(
                f"after number {before} the clock stepped by {step:.4g} s, or ping stood still"
            )
    return max(period, 1e-6)
