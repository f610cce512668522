"""Read the delays and losses of real links from logs of ping, fping and irtt, and from CSV files.

    ping -D -O HOST, ping --apple-time HOST, fping -D HOST
    irtt client -i 10ms -l 204 -d 1m -o irtt.json HOST

Every reader fills a `Log` with rows, and `Log.packets` checks the rows. `Packets.notes` counts the
rows that are left out, merged or sorted. A log with more than 1 % unusable rows is rejected.
docs/link.md describes the formats.

Source: ping(8) of iputils, macOS and BusyBox; fping(8); irtt-client(1), JSON format 1.
"""

from __future__ import annotations

import json
import re
from collections import Counter
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field, replace
from datetime import datetime
from math import isnan, nan
from typing import Any, Literal, TypeAlias

import numpy as np

from cloudrc.errors import BadInputError
from cloudrc.link.doubts import describe_period
from cloudrc.link.model import Array, Stream
from cloudrc.link.profile import Trace
from cloudrc.link.traces import LATEST, Row, looks_lost, read_rows

Direction: TypeAlias = Literal["uplink", "downlink"]
Entry: TypeAlias = tuple[float, float]
"""Time of sending [s] and delay [s]; the delay is NaN if the packet was lost."""
LONGEST = 5.0  # largest plausible median delay [s]; a larger median suggests that the unit is wrong
RARE = 86_400.0  # implausible time between packets [s]: a longer one is refused
UNUSABLE_MAX = 0.01  # largest share of rows that may be left out, in [0, 1]
GAP, GAP_MIN, BACK_MAX = 5, 0.1, 1.0
"""A gap between packets, or a jump back, is reported if it is longer than GAP_MIN [s] and longer
than GAP times the median time between packets. A log that jumps back by BACK_MAX [s] is refused."""
PACKETS_MAX = 10_000_000  # limit for packets in a log of ping; more mean a wrong sequence number
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
    """The packets that a reader finds in a log, and the number of rows that it left out."""

    name: str
    entries: list[Entry] = field(default_factory=list)  # the packets in the order of the log
    counts: Counter[str] = field(default_factory=Counter)  # what was done -> number of rows
    unusable: list[str] = field(default_factory=list)  # one reason for each unusable row
    halved: bool = False  # whether the delays are halves of round trips
    unmeasured: set[float] = field(default_factory=set)
    """Times of sending [s] of packets that arrived with an unknown delay, NaN in `entries`."""
    elsewhere: list[float] = field(default_factory=list)
    """Times [s] at which a packet is missing: the other direction or the recording has lost it."""

    def packets(self) -> Packets:
        """Check the packets, sort them by time of sending, and add a note on each correction.

        Raise a BadInputError if no packet has a delay; if a delay is negative; if the times jump
        far back, as after a step of the clock; if more than 1 % of the rows are unusable; or if
        more than 1 % of the packets have the time of an earlier packet.
        """
        self._refuse_beyond_limit(len(self.unusable), *self.unusable[:1])
        times, delays = np.array(self.entries or [(nan, nan)]).T
        if np.isnan(delays).all():
            raise self.error("no packet has a delay; give a log with at least one reply")
        self.refuse_early(float(np.nanmin(delays)))
        period = float(np.median(np.abs(np.diff(times)))) if len(times) > 1 else 0.0
        far = max(GAP_MIN, GAP * period)
        jumps = self._jumps(times, delays, far)
        unique = dict(reversed(self.entries))  # of packets with the same time, the first is kept
        repeated = len(times) - len(unique)
        same = f"{repeated} of {len(times)} packets have the same time as another one"
        cause = jumps[0] if jumps else "give times with more digits"
        self._refuse_beyond_limit(repeated, f"{self.name}: {same}; {cause}")
        self.counts["out of order, sorted"] += int(np.sum(times < np.maximum.accumulate(times)))
        self.counts["left out, at the time of another one"] += repeated
        self.counts["left out, unreadable"] += len(self.unusable)
        notes = [f"{count} {what}" for what, count in self.counts.items() if count] + jumps
        sent, delays = np.array(sorted(unique.items())).T
        gaps = np.diff(np.sort([*sent, *self.elsewhere]))
        if gaps.max(initial=0.0) > far:
            notes.append(
                f"nothing sent for {gaps.max():.4g} s after packet {gaps.argmax() + 1}: a pause, "
                "two sessions in one log, or a step of the clock"
            )
        copies = (np.isfinite(delays) | np.isin(sent, [*self.unmeasured])).astype(int)
        return Packets(sent, delays, copies, tuple(notes), self.halved)

    def _jumps(self, times: Array, delays: Array, far: float) -> list[str]:
        """Return a note if the times go back by more than `far` [s] and stay back.

        Rows in the order of arrival are no jump, nor is a single row out of order: the medians of
        11 rows before and after, less the usual progress, have to differ. Raise a BadInputError if
        a jump is at least BACK_MAX [s]: sorting would mix two sessions.
        """
        steps = np.diff(times)
        usual = np.median(steps) if len(steps) else 0.0
        arrivals = times + delays * (2 if self.halved else 1)
        back = np.flatnonzero((steps < min(usual - far, 0.0)) & ~(np.diff(arrivals) >= 0.0))
        back = back[(back > 0) & (back < len(steps) - 1)]  # a first or last row tells nothing
        level = np.pad(times - usual * np.arange(len(times)), 10, constant_values=nan)
        around = np.lib.stride_tricks.sliding_window_view(level, 11)
        before = np.nanquantile(around[back], 0.5, axis=1, method="lower")
        after = np.nanquantile(around[back + 11], 0.5, axis=1, method="higher")
        back = back[before - after > far / 2]
        if not len(back):
            return []
        at = back[steps[back].argmin()]
        note = (
            f"after row {at + 1} the times go back by {-steps[at]:.4g} s"
            f"{f', the longest of {len(back)} such jumps' if len(back) > 1 else ''}: a step of the "
            "clock, midnight in times without a date, or several sessions in one log"
        )
        if -steps[at] >= BACK_MAX:
            raise self.error(f"{note}; give the rows of one session, sorted by time")
        return [note]

    def error(self, text: str) -> BadInputError:
        """Make an error that begins with the name of the log."""
        return BadInputError(f"{self.name}: {text}")

    def refuse_early(self, least: float) -> None:
        """Raise a BadInputError if the shortest delay in the log, `least` [s], is negative."""
        if least < 0.0:
            raise self.error(
                f"a packet arrived {-least * 1e3:.4g} ms before it was sent: the two clocks differ;"
                " synchronise them, or use round trips and take half of each (--halve-rtt)"
            )

    def _refuse_beyond_limit(self, count: int, reason: str = "") -> None:
        rows = len(self.entries) + len(self.unusable)
        if count > UNUSABLE_MAX * rows:
            more = f" ({count} of {rows} rows cannot be used)" if count > 1 else ""
            raise BadInputError(reason + more)


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


_OTHERS = {
    r'"start":\s*\{\s*"connected"|"version":\s*"iperf|^iperf|^\[ *ID\] +Interval': "iperf",
    r"[=<]\d+ ?\S{1,3} TTL=\d+|^Pinging ": "ping of Windows",
    r"^traceroute to|Loss% +Snt|^Tracing route": "traceroute or mtr",
}
"""Pattern in a file's first lines -> the tool that wrote the file."""


def refuse_others(lines: list[str], name: str) -> None:
    """Raise an error if the lines are from a tool that does not report the delay of each packet."""
    head = "\n".join(lines[:50])
    for pattern, tool in _OTHERS.items():
        if re.search(pattern, head, re.MULTILINE):
            raise BadInputError(
                f"{name}: the output of {tool}, which lacks the number, time or delay of each "
                "packet; measure with irtt or ping -D (on Windows in WSL)"
            )


_MISSHAPEN = ArithmeticError, AttributeError, LookupError, RecursionError, TypeError, ValueError
"""Errors that reading JSON with an unexpected layout can raise."""


def read_irtt(text: str, name: str, direction: Direction | None, *, halve: bool) -> Packets:
    """Read the output of `irtt client -o FILE.json`.

    The packets that irtt's client sends count as the uplink. A packet that was lost on the way back
    has arrived on the uplink, with an unknown delay. If irtt does not know in which
    direction a packet was lost, the packet counts as lost in both directions. The times of sending
    are on the client's monotonic clock, so steps of the client's wall clock have no effect.

    `halve`: use half of each round trip as one-way delay, and ignore `direction`. Without `halve`,
    `direction` selects the one-way delays to read. `name` is the file name for messages.

    Raises:
        BadInputError: If the file is no output of irtt, if its packets contradict its own
            statistics, or if it has no usable one-way delays and `halve` is false.
    """
    log = Log(name, halved=halve)
    try:
        document = json.loads(text)
        trips = document["round_trips"]
        if direction is None and not halve:
            raise log.error(
                "irtt measures both directions; choose --direction uplink (sent by its client) or "
                "downlink"
            )
        arrived = [trip for trip in trips if _arrived(trip)]
        _compare_counts(document.get("stats") or {}, len(trips), len(arrived), log)
        if not halve:
            _check_clocks(arrived, log)
        _read_trips(trips, "halves" if halve or not direction else direction, log)
    except _MISSHAPEN as error:
        raise log.error(
            f"not a log of irtt ({type(error).__name__}: {error}); give the file that 'irtt client "
            "-o FILE.json' writes"
        ) from None
    return log.packets()


def _arrived(trip: dict[str, Any]) -> bool:
    return str(trip["lost"]).lower() == "false"


def _compare_counts(stats: dict[str, Any], packets: int, replies: int, log: Log) -> None:
    copies = int(stats.get("duplicates", 0))
    log.counts["duplicates left out"] += copies
    sent = int(stats.get("packets_sent", packets))
    received = int(stats.get("packets_received", replies))
    if sent != packets or received not in (replies, replies + copies):
        raise log.error(
            f"its counts are {sent} sent and {received} received, but it has {packets} packets "
            f"and {replies} replies; give the whole file of irtt"
        )


def _check_clocks(arrived: list[dict[str, Any]], log: Log) -> None:
    """Raise an error if irtt's one-way delays are missing or wrong.

    They are wrong if the clocks of client and server differ, or if one of the clocks steps.
    """
    if any(not {"send", "receive"} <= trip["delay"].keys() for trip in arrived):
        raise BadInputError(f"{log.name} (irtt's server sent no stamps): has round trips; {HALVE}")
    both = [int(trip["delay"][key]) for trip in arrived for key in ("send", "receive")]
    log.refuse_early(min(both, default=0) * 1e-9)
    for end, event in (("client", "send"), ("server", "receive")):
        stamps = [trip["timestamps"][end][event] for trip in arrived]
        passed, wall = (
            np.diff([int(stamp.get(clock, 0)) for stamp in stamps if "monotonic" in stamp])
            for clock in ("monotonic", "wall")
        )
        # 1 ms, plus 0.1 % for a clock that NTP adjusts.
        far = np.flatnonzero(np.abs(wall - passed) > 1_000_000 + passed // 1000)
        if len(far):
            raise log.error(
                f"the clock of irtt's {end} made a step of {(wall - passed)[far[0]] * 1e-6:.4g} "
                "ms; measure again, or take half of each round trip (--halve-rtt)"
            )


_IRTT_KEYS = {"halves": "rtt", "uplink": "send", "downlink": "receive"}
"""Delays to read -> irtt's key of the delay."""


def _read_trips(trips: list[dict[str, Any]], what: str, log: Log) -> None:
    """Read the time of sending and the delay of each packet [s] into `log`; the first time is 0.

    `what` is "uplink", "downlink", or "halves" for half of each round trip. On the downlink,
    packets lost on the uplink are left out. The time is always that of the client, even for the
    downlink: a lost packet has no time of the server.
    """
    part = 0.5e-9 if what == "halves" else 1e-9
    stamps = [trip["timestamps"]["client"]["send"] for trip in trips]
    sent_ns = [int(stamp.get("monotonic", stamp.get("wall"))) for stamp in stamps]
    start = min(sent_ns, default=0)
    for trip, stamp_ns in zip(trips, sent_ns, strict=True):
        sent, lost = (stamp_ns - start) * 1e-9, str(trip["lost"]).lower()
        if (what, lost) == ("downlink", "true_up"):
            log.elsewhere.append(sent)
            continue
        delay = int(trip["delay"][_IRTT_KEYS[what]]) * part if _arrived(trip) else nan
        log.entries.append((sent, delay))
        if (what, lost) == ("uplink", "true_down"):
            log.unmeasured.add(sent)
            log.counts["lost on the way back, delay unknown"] += 1


SCALES = {"s": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9}
FINER = {"s": "ms", "ms": "us", "us": "ns", "ns": "ns"}
TIMES, DELAYS, LOSSES = ("time", "timestamp", "sent"), ("delay", "rtt"), ("loss", "lost")
COLUMNS = "time_s and delay_ms, or with _s, _ms, _us or _ns; rtt_ for round trips; and loss"
_LOST_WORDS = {
    *("", "-", "*", "nan", "-nan", "inf", "none", "null", "na", "n/a"),
    *("lost", "loss", "timeout", "timed out", "request timed out", "no answer yet"),
}
"""Words in the delay column that mark a lost packet."""
_LOST_NUMBERS = {-1.0, -999.0, -9999.0}  # mark a lost packet if no other delay is negative
_FLAGS = {"false": 0.0, "no": 0.0, "true": 1.0, "yes": 1.0}
"""Word in the loss column -> 1 if the packet was lost."""


def read_csv(lines: Iterable[str], name: str, *, halve: bool, trust_units: bool) -> Packets:
    """Read a CSV log with a header; unknown columns are skipped.

    A packet counts as lost in any of these cases:

    - The column `loss` contains 1.
    - The delay is empty, or a word such as "timeout".
    - The delay is -1, -999 or -9999, and the column has no other negative number.
    - The delay is 0, all other delays are far from 0, and the log has no column `loss`.

    With `halve`, the log may have round-trip times; half of each counts as one-way delay. With
    `trust_units`, values that seem to be in another unit are accepted. `name` is the file name for
    messages.

    Raises:
        BadInputError: If the log cannot be used; the text names line, value and remedy.
    """
    columns, rows = read_rows(lines, name)
    time, time_unit = _find(columns, TIMES, name)
    delay, unit = _find(columns, DELAYS, name)
    if not unit:
        raise BadInputError(f"{name}: {_no_unit(delay)}")
    log = Log(name, halved=delay.startswith("rtt"))
    if log.halved and not halve:
        raise BadInputError(f"{name}, column {delay}: has round trips; {HALVE}")
    loss = _find_loss(columns, name)
    raw = list[Entry]()
    for row in rows:
        try:
            raw.append((_csv_time(row, time, time_unit), _csv_delay(row, delay, loss)))
        except BadInputError as error:
            log.unusable.append(str(error))
    raw = _without_marks(raw, delay, log, has_losses=loss is not None)
    # For nanoseconds since 1970 a float has a resolution of 256 ns, which is enough here.
    start = min((sent for sent, _ in raw), default=0.0)
    scales = SCALES[time_unit or "s"], SCALES[unit] * (0.5 if log.halved else 1.0)
    log.entries = [((sent - start) * scales[0], value * scales[1]) for sent, value in raw]
    packets = log.packets()
    return packets if trust_units else _check_units(packets, time, delay, unit, name)


def _check_units(packets: Packets, time: str, delay: str, unit: str, name: str) -> Packets:
    """Refuse delays that are probably not in `unit`; refuse or note times in an unlikely unit."""
    factor, found = 1 / SCALES[unit], ""
    top, middle = np.nanmax(packets.delays), np.nanmedian(packets.delays)
    period = float(np.median(np.diff(packets.sent))) if len(packets.sent) > 1 else 1.0
    note = describe_period(period, time)
    if unit != "s" and 0.0 < top * factor < 1.0:
        found = f"{delay} is at most {top * factor:.4g} {unit}, which looks like seconds"
    elif middle > LONGEST:
        seen = f"{middle * factor:.6g} {unit}"
        found = f"{delay} has a median of {seen}, which looks like {FINER[unit]}"
    elif period > RARE:
        found = note
    if found:
        raise BadInputError(
            f"{name}: {found}; name the column after its unit, or use --trust-units"
        )
    return replace(packets, notes=(*packets.notes, note)) if note else packets


def _find(columns: list[str], kinds: tuple[str, ...], name: str) -> tuple[str, str]:
    """Find the only column named after one of `kinds`, as in `delay_ms` or, without unit, `delay`.

    Return the column's name and its unit; "" without unit. Raise an error if there is none, or more
    than one; `name` is the log's name, for the error.
    """
    known = {f"{kind}_{unit}": unit for kind in kinds for unit in SCALES}
    found = [column for column in columns if column in known]
    found = found or [column for column in columns if column in kinds]
    if len(found) == 1:
        return found[0], known.get(found[0], "")
    if found:
        raise BadInputError(f"{name}: has {' and '.join(found)}; keep only one of them")
    shown = ",".join(columns)[:200] or "nothing"
    raise BadInputError(f"{name}: no column {kinds[0]}, found {shown}; name them {COLUMNS}")


def _find_loss(columns: list[str], name: str) -> str | None:
    """Return the column that marks lost packets; None without one.

    Raise an error if the only such column has another name, such as loss_percent.
    """
    for column in LOSSES:
        if column in columns:
            return column
    for column in columns:
        if any(word in column for word in LOSSES):
            raise BadInputError(
                f"{name}: column {column} is not read; call it loss and give 0 or 1 for a packet, "
                "or remove it"
            )
    return None


def _no_unit(column: str) -> str:
    names = ", ".join(f"{column}_{unit}" for unit in ("s", "ms", "us"))
    return f"column {column} does not say its unit; call it {names} or {column}_ns"


def _csv_time(row: Row, column: str, unit: str) -> float:
    """Read a time in `unit`; without a unit, convert date and time to time since 1970 [s]."""
    text = row.text(column)
    if not unit:
        try:
            return datetime.fromisoformat(text).timestamp()
        except ValueError:
            if _is_number(row, column):
                raise BadInputError(f"{row.where}: {_no_unit(column)}") from None
            shown = repr(text[:40]) if text else "nothing"
            wanted = "give date and time as 2024-01-20T10:00:00.5"
            raise BadInputError(f"{row.where}: {column} is {shown}; {wanted}") from None
    value = row.number(column)
    if value * SCALES[unit] > LATEST:
        raise BadInputError(f"{row.where}: {column} is {text}, a finer unit than {unit}; rename it")
    return value


def _is_number(row: Row, column: str) -> bool:
    try:
        row.number(column)
    except BadInputError:
        return False
    return True


def _csv_delay(row: Row, column: str, loss: str | None) -> float:
    """Read the delay of a packet from `column`, in the column's unit; return NaN for a lost packet.

    `loss` is the column that marks lost packets; None if the file has no such column.
    """
    if loss is not None:
        remedy = "0 or 1 for a packet; a profile can use a trace with other shares directly"
        flag = _FLAGS.get(row.text(loss).lower())
        if flag is None:
            flag = row.number(loss)
        if flag not in (0.0, 1.0):
            raise BadInputError(f"{row.where}: {loss} is {row.text(loss)[:40]!r}; give {remedy}")
        if flag:
            return nan
    return nan if row.text(column).lower() in _LOST_WORDS else row.number(column)


def _without_marks(raw: list[Entry], column: str, log: Log, *, has_losses: bool) -> list[Entry]:
    """Replace by NaN each number that stands for a lost packet, such as -1; count these packets.

    With `has_losses`, the log has a column `loss`; then 0 never stands for a lost packet.
    """
    marks = _marks({value for _, value in raw if not isnan(value)}, column, log)
    if has_losses:
        marks -= {0.0}
    for mark in marks:
        what = f"with {column} {mark:g} taken as lost"
        log.counts[what] = sum(value == mark for _, value in raw)
    return [(sent, nan if value in marks else value) for sent, value in raw]


def _marks(values: set[float], column: str, log: Log) -> set[float]:
    """Return the numbers among the `values` of a column that stand for a lost packet."""
    below = {value for value in values if value < 0.0}
    marks = below & _LOST_NUMBERS if len(below) == 1 else set[float]()
    if below and not marks and log.halved:
        raise BadInputError(
            f"{log.name}: {column} is {min(below):g}, which is no round trip; leave the cell of a "
            "lost packet empty"
        )
    return marks | {0.0} if looks_lost(values - below) else marks


_WRAP = 1 << 16
_STAMP = re.compile(
    r"^(?:\[?(?P<unix>(?<=\[)\d+(?:\.\d+)?|\d{9,10}\.\d+)\]?(?: +|$)"
    r"|(?P<clock>\d\d:\d\d:\d\d\.\d+)\S* +)"
)
"""Time stamp at the start of a line, from `ping -D`, `ts '[%.s]'` or `ping --apple-time`."""
_NUMBER = re.compile(r"\b(?:icmp6?_)?(?:seq|req)[= ](\d{1,12})\b|(?<= : )\[(\d{1,12})\], ")
_ROUND_TRIP = re.compile(r"(?:[=<] ?|, )(\d+(?:[.,]\d+)?) ?(?:ms|msec|msek|мс|毫秒|ミリ秒)(?=\W|$)")
_REPLY = re.compile(r"ttl=|hlim=|bytes from", re.IGNORECASE)
_SUMMARY = re.compile(r"xmt/rcv/%loss = (\d+)/(\d+)/|^(?!.*xmt/)\D*(\d+)\D+(\d+)\D.*%")
"""Summary at the end: packets sent, packets received."""
_HEADS = "PING ", "PING6("
_EXPECTED = re.compile(r"\s*$|---|.*min/avg/")
"""Lines around the summary, which are not reported as left out."""
_STAMPS_BY = (
    "Linux: ping -D; macOS: ping --apple-time (-D does not print times there); fping: -D; "
    "BusyBox, BSD: ping HOST | ts '[%.s]'"
)
"""How to get time stamps from each kind of ping."""


def is_ping(lines: list[str]) -> bool:
    """Return whether a text looks like the output of ping."""
    return any(_NUMBER.search(line) or line.startswith("PING ") for line in lines[:1000])


def read_ping(lines: list[str], name: str, *, halve: bool) -> Packets:
    """Read the output of `ping -D` or of a similar program, in any language.

    The one-way delay is half of each round trip; `halve` has to permit this. Packets count as lost
    if their sequence number is missing between replies, if a line such as "no answer yet" reports
    them, or if only the summary counts them. Without a summary, packets after the last line are
    ignored.

    Raises:
        BadInputError: If `halve` is false; if the log `name` has no replies, no time stamps, too
            many packets or several sessions; or if it contradicts its summary.
    """
    log = Log(name, halved=True)
    if not halve:
        raise log.error(f"ping measures round trips; {HALVE}")
    packets = list(_ping_packets(lines, log))
    number, stamp, trip = np.array(packets or [(0, nan, nan)]).T
    replied = np.isfinite(trip)
    if not replied.any():
        raise BadInputError(
            [*log.unusable, f"{name}: has no replies; give the output of: ping -D -O HOST"][0]
        )
    known, index, times = np.unique(number[replied], return_index=True, return_counts=True)
    if times.max() > 1:
        raise _sessions(f"number {known[times.argmax()]:.0f} comes twice", log)
    late = replied & (number < np.maximum.accumulate(number))
    log.counts["out of order, sorted"] += int(late.sum())
    others = [_STAMP.sub("", line) for line in lines if not _NUMBER.search(line)]
    first, last = _ping_range(int(number.min()), int(number.max()), len(known), others, log)
    sent, delays = (stamp - trip)[replied][index], np.full(last - first + 1, nan)
    delays[known.astype(int) - first] = trip[replied][index] / 2
    n, at = known, sent
    if len(known) < 2:  # the lines about lost packets then give the time between two packets
        n, at = np.array(sorted({n: at for n, at, _ in packets if not isnan(at)}.items())).T
    period = max(float(np.median(np.diff(at) / np.diff(n))), 1e-6) if len(n) > 1 else 1.0
    # Without a reply, the time of sending is interpolated between the neighbouring replies.
    numbers = np.arange(first, last + 1)
    outside = np.minimum(numbers - known[0], 0) + np.maximum(numbers - known[-1], 0)
    sends = np.interp(numbers, known, sent) + outside * period
    log.entries = list(zip(sends.tolist(), delays.tolist(), strict=True))
    return log.packets()


def _ping_range(
    first: int, last: int, replies: int, others: list[str], log: Log
) -> tuple[int, int]:
    """Return the first and last sequence number of a log according to ping's own summary.

    Without a summary, return `first` and `last`, the smallest and largest number in the lines of
    packets. `others` are the other lines; unknown lines are counted in `log`. Raise a BadInputError
    if the log has several sessions of ping or too many packets, or if the summary does not match
    the number of `replies`.
    """
    head, total = _head_and_summary(others, log)
    if total is not None:
        # fping begins with 0, and so does a ping whose header has "data bytes".
        from_0 = first == 0 or "xmt/" in total.string or " data bytes" in head
        first, last = _summed_up(total, 0 if from_0 else 1, last, replies, log)
    if last - first >= PACKETS_MAX:
        raise log.error(
            f"its sequence numbers span {last - first + 1} packets, more than {PACKETS_MAX}; "
            "give the output of one ping"
        )
    return first, last


def _head_and_summary(others: list[str], log: Log) -> tuple[str, re.Match[str] | None]:
    """Return ping's first line ("" without one) and its summary; count unknown lines in `log`."""
    heads = [line for line in others if line.startswith(_HEADS)]
    ends = [line for line in others if not line.startswith(_HEADS)]
    totals = [found for line in ends if (found := _SUMMARY.search(line))]
    expected = sum(_EXPECTED.match(line) is not None for line in ends if not _SUMMARY.search(line))
    log.counts["other lines left out"] += len(ends) - len(totals) - expected
    if (beginnings := max(len(heads), len(totals))) > 1:
        raise _sessions(f"{beginnings} beginnings or ends", log)
    return "".join(heads), totals[0] if totals else None


def _summed_up(
    total: re.Match[str], base: int, last: int, replies: int, log: Log
) -> tuple[int, int]:
    """Return the first and last sequence number according to the line `total` of the summary.

    The numbers begin with `base`. Raise a BadInputError if the summary does not match the number of
    `replies`, or the number `last` that the lines of packets reach.
    """
    sent, received = (int(word) for word in total.groups() if word)
    if received != replies or sent < last - base + 1:
        raise log.error(
            f"its summary counts {sent} sent and {received} received, but it has {replies} "
            f"replies up to number {last}; give the whole log"
        )
    return base, base + sent - 1


def _sessions(sign: str, log: Log) -> BadInputError:
    return log.error(f"has more than one session of ping ({sign}); give the lines of one session")


def _ping_packets(lines: list[str], log: Log) -> Iterator[tuple[int, float, float]]:
    """Yield each packet's number, time stamp [s] and round trip [s]; NaN for what is missing."""
    newest = 0
    for line in lines:
        number, trip, stamp = _NUMBER.search(line), _ROUND_TRIP.search(line), _STAMP.match(line)
        if number is None:
            continue
        if trip is None and _REPLY.search(line):
            reason = f"a reply without a time that can be read: {line.strip()[:60]!r}"
            log.unusable.append(f"{log.name}: {reason}; run: LC_ALL=C ping -D -O HOST")
        elif trip and stamp is None:
            raise log.error(f"its lines have no time stamps; {_STAMPS_BY}")
        elif "DUP!" in line:
            log.counts["duplicates left out"] += 1
        else:
            count = int(number[1] or number[2])
            # After 65535 ping goes on with 0. A late reply may have a number from before that.
            count += _WRAP * max(0, round((newest - count) / _WRAP))
            newest = max(newest, count)
            found = float(trip[1].replace(",", ".")) * 1e-3 if trip else nan
            yield count, _ping_time(stamp) if stamp else nan, found


def _ping_time(stamp: re.Match[str]) -> float:
    """Convert a time stamp to the time since 1970 or, without a date, since midnight [s]."""
    if stamp["unix"]:
        return float(stamp["unix"])
    hours, minutes, seconds = map(float, stamp["clock"].split(":"))
    return hours * 3600 + minutes * 60 + seconds
