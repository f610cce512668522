"""Read the packets of measured links from logs of irtt and from CSV files.

    irtt client -i 10ms -l 203 -d 1m -o irtt.json HOST

A telemetry datagram has 203 bytes, a command datagram 88 bytes. irtt measures both directions if
the clocks of the two hosts agree. `link/ping.py` reads logs of ping.

The columns of a CSV log name their units. `time_ms,delay_us,loss` are the time of sending, the
one-way delay and the loss (0 or 1). `timestamp_ns,rtt_ms` has round trips; the reader takes half of
each round trip if the user asks for that.

Every reader fills a `Log`, and `Log.packets` makes the same checks for all logs. `Packets.notes`
counts the rows that are left out, merged or sorted. A log is refused if more than 1 % of its rows
cannot be used.
"""

from __future__ import annotations

import json
import re
from collections import Counter
from collections.abc import Iterable
from dataclasses import dataclass, field
from datetime import datetime
from itertools import pairwise
from math import isfinite, isnan
from operator import itemgetter
from statistics import median
from typing import Any, Literal, TypeAlias

from cloudrc.errors import BadInputError
from cloudrc.link.profile import Trace
from cloudrc.link.traces import Row, Table, decimals_of, looks_lost, shown

Direction: TypeAlias = Literal["uplink", "downlink"]
LONGEST = 5.0
"""Longest plausible median delay [s]; values with a larger median are probably in another unit."""
UNUSABLE_MAX = 0.01
"""Largest share of rows that may be left out [1]; above this share the log is refused."""
GAP = 20
"""Shortest gap that a note reports, as a multiple of the median time between packets [1]. The gap
must also be longer than `GAP_MIN`."""
GAP_MIN = 1.0
"""Shortest gap that a note reports [s]."""
STEPS_MAX = 3
"""Up to this number of jumps back in time, a jump is a step of the clock or a new session [1]. More
jumps mean that the rows are shuffled."""
_MISSHAPEN = ArithmeticError, AttributeError, LookupError, RecursionError, TypeError, ValueError
"""Errors that JSON with an unexpected layout can raise."""
HALVE = (
    "a trace is one way; if both directions are alike, use half of each round trip with "
    "--halve-rtt; otherwise measure one way with irtt between synchronised clocks"
)
_CLOCKS = "the two clocks differ; synchronise them, or take half of each round trip (--halve-rtt)"


@dataclass(frozen=True, slots=True)
class Packets:
    """The packets of a log in the order of sending.

    Attributes:
        sent: Times of sending, on any clock, strictly rising [s], shape (n,).
        delays: One-way delays [s], None for lost packets, shape (n,).
        notes: What was left out, merged or sorted, and how often.
        halved: Whether the delays are halves of round trips.
    """

    sent: tuple[float, ...]
    delays: tuple[float | None, ...]
    notes: tuple[str, ...] = ()
    halved: bool = False

    @property
    def arrived(self) -> list[float]:
        """Return the delays of the packets that arrived [s]."""
        return [delay for delay in self.delays if delay is not None]

    @property
    def lost(self) -> int:
        """Return the number of lost packets."""
        return len(self.delays) - len(self.arrived)

    @property
    def duration(self) -> float:
        """Return the time from the first to the last packet sent [s]."""
        return self.sent[-1] - self.sent[0]


@dataclass(slots=True)
class Log:
    """The rows that a reader finds in a source.

    Attributes:
        name: Name of the source, for messages.
        entries: Time of sending [s] and delay [s] (None if lost), in the order of the source.
        counts: What was left out, merged or changed -> how often.
        unusable: One reason for each row that cannot be used.
        facts: Further notes.
        halved: Whether the delays are halves of round trips.
        clocks: What the user should do if the two clocks differ.
    """

    name: str
    entries: list[tuple[float, float | None]] = field(default_factory=list)
    counts: Counter[str] = field(default_factory=Counter)
    unusable: list[str] = field(default_factory=list)
    facts: list[str] = field(default_factory=list)
    halved: bool = False
    clocks: str = _CLOCKS

    def packets(self) -> Packets:
        """Check the packets, sort them by the time of sending, and note what was changed.

        Raises:
            BadInputError: If more than 1 % of the rows cannot be used, if more than 1 % repeat the
                time of an earlier row, if no packet arrived, if a delay is negative, or if the
                times jump back one to three times.
        """
        self._refuse_beyond_limit(len(self.unusable), self.unusable[0] if self.unusable else "")
        arrived = [delay for _, delay in self.entries if delay is not None]
        if not arrived:
            raise BadInputError(
                f"{self.name}: no packet arrived; give a log with at least one reply"
            )
        if (least := min(arrived)) < 0.0:
            early = f"a packet arrived {-least * 1e3:.4g} ms before it was sent"
            raise BadInputError(f"{self.name}: {early}: {self.clocks}")
        self._refuse_steps()
        unique = dict(reversed(self.entries))  # of packets with the same time the first remains
        repeated = len(self.entries) - len(unique)
        same = "have the same time as another one; give times with more digits"
        self._refuse_beyond_limit(
            repeated, f"{self.name}: {repeated} of {len(self.entries)} packets {same}"
        )
        newest = self.entries[0][0]
        for sent, _ in self.entries:
            self.counts["out of order, sorted"] += sent < newest
            newest = max(newest, sent)
        self.counts["left out, at the time of another one"] += repeated
        self.counts["left out, unreadable"] += len(self.unusable)
        ordered = sorted(unique.items(), key=itemgetter(0))
        notes = [f"{count} {what}" for what, count in self.counts.items() if count]
        times = tuple(sent for sent, _ in ordered)
        return Packets(
            times,
            tuple(delay for _, delay in ordered),
            (*notes, *self.facts, *_gaps(times)),
            self.halved,
        )

    def _refuse_steps(self) -> None:
        """Refuse times that jump far back one to three times: sorting would mix two sessions."""
        steps = [after - before for (before, _), (after, _) in pairwise(self.entries)]
        far = max(GAP_MIN, GAP * median([abs(step) for step in steps] or [0.0]))
        back = [row for row, step in enumerate(steps, 1) if step < -far]
        if 1 <= len(back) <= STEPS_MAX:
            by = -steps[back[0] - 1]
            raise BadInputError(
                f"{self.name}: after row {back[0]} the times go back by {by:.4g} s: a step of "
                "the clock, or two sessions in one log; give the rows before or after it"
            )

    def _refuse_beyond_limit(self, count: int, reason: str) -> None:
        rows = len(self.entries) + len(self.unusable)
        if count > UNUSABLE_MAX * rows:
            more = f" ({count} of {rows} rows cannot be used)" if count > 1 else ""
            raise BadInputError(reason + more)


def _gaps(times: tuple[float, ...]) -> list[str]:
    """Report the longest time without a packet, if it is unusual for this log."""
    steps = [after - before for before, after in pairwise(times)]
    longest = max(steps, default=0.0)
    if longest <= max(GAP_MIN, GAP * median(steps or [0.0])):
        return []
    row = steps.index(longest) + 1
    return [
        f"nothing sent for {longest:.4g} s after packet {row}: a pause, two sessions in one log, or"
        " a step of the clock"
    ]


def trace_of(packets: Packets) -> Trace:
    """Make a trace that reproduces the delays and losses for a stream of the same rate.

    Each row begins halfway between its packet and the packet before. So a replayed packet may be
    late or early by half a period and still meets its own row. Time begins at the first packet.

    Returns:
        One row per packet; the losses are None if nothing was lost.
    """
    sent = packets.sent
    times = [0.0]
    times += [(before + after) / 2 - sent[0] for before, after in pairwise(sent)]
    delays = []
    delay = packets.arrived[0]
    for given in packets.delays:
        delay = delay if given is None else given
        delays.append(delay)
    losses = tuple(1.0 if given is None else 0.0 for given in packets.delays)
    return Trace(tuple(times), tuple(delays), losses if packets.lost else None)


_IPERF = "the output of iperf, which has no delay of each packet; measure with irtt or ping -D"
_OTHERS = {
    r'"start":\s*\{\s*"connected"|"version":\s*"iperf|^iperf|^\[ *ID\] +Interval': _IPERF,
    r"[=<]\d+ ?\S{1,3} TTL=\d+|^Pinging ": (
        "the output of ping of Windows, which has neither numbers nor times of sending; measure "
        "with ping -D in WSL, or with irtt"
    ),
    r"^traceroute to|Loss% +Snt|^Tracing route": (
        "the output of traceroute or mtr, which has no delay of each packet; give one of ping -D"
    ),
}
"""Pattern in a file's first lines -> which tool wrote the file, and what the user should give."""


def refuse_others(lines: list[str], name: str) -> None:
    """Refuse the output of a tool that does not measure the delay of each packet; name the tool."""
    head = "\n".join(lines[:50])
    for pattern, what in _OTHERS.items():
        if re.search(pattern, head, re.MULTILINE):
            raise BadInputError(f"{name}: {what}")


def read_irtt(text: str, name: str, direction: Direction | None, *, halve: bool) -> Packets:
    """Read the output of `irtt client -o FILE.json`.

    The client stands for the robot: its packets are the uplink. If irtt does not know in which
    direction a packet was lost, the packet counts as lost in both directions. Times of sending are
    on the client's monotonic clock, so steps of its wall clock do not matter.

    Source: irtt-client(1), JSON format 1.

    Args:
        text: Content of the file.
        name: Name of the file, for messages.
        direction: Direction to read; None only with `halve`.
        halve: True: use half of each round trip. False: use the one-way delay.

    Raises:
        BadInputError: If the file is not such an output, if it contradicts its own counts, or if
            `halve` is false and the file has no usable one-way delays.
    """
    log = Log(name)
    try:
        document = json.loads(text)
        trips = document["round_trips"]
        if direction is None and not halve:
            raise BadInputError(
                f"{name}: irtt measures both directions; choose --direction uplink (sent by its "
                "client) or downlink"
            )
        _compare_counts(document.get("stats") or {}, trips, log)
        if not halve:
            _check_clocks(trips, name)
        log.entries = _irtt_entries(trips, "halves" if halve or not direction else direction)
        log.halved = halve
    except _MISSHAPEN as error:
        raise BadInputError(
            f"{name}: not a log of irtt ({type(error).__name__}: {error}); "
            "give the file that 'irtt client -o FILE.json' writes"
        ) from None
    return log.packets()


def _compare_counts(stats: dict[str, Any], trips: list[dict[str, Any]], log: Log) -> None:
    """Compare the packets of an irtt log with the counts in the same log."""
    arrived = sum(_lost(trip) == "false" for trip in trips)
    copies = int(stats.get("duplicates", 0))
    log.counts["duplicates left out"] += copies
    sent = int(stats.get("packets_sent", len(trips)))
    received = int(stats.get("packets_received", arrived))
    if sent != len(trips) or received not in (arrived, arrived + copies):
        raise BadInputError(
            f"{log.name}: its counts are {sent} sent and {received} received, but it has "
            f"{len(trips)} packets and {arrived} replies; give the whole file of irtt"
        )


def _check_clocks(trips: list[dict[str, Any]], name: str) -> None:
    """Reject one-way delays that are missing, or if the clocks differ or step, in both ways."""
    arrived = [trip for trip in trips if _lost(trip) == "false"]
    if any(not {"send", "receive"} <= trip["delay"].keys() for trip in arrived):
        raise _refusal(f"{name} (irtt's server sent no stamps)")
    least = min(
        (int(trip["delay"][key]) for trip in arrived for key in ("send", "receive")), default=0
    )
    if least < 0:
        early = f"a packet arrived {-least * 1e-6:.4g} ms before it was sent"
        raise BadInputError(f"{name}: {early}: {_CLOCKS}")
    for end, event in (("client", "send"), ("server", "receive")):
        stamps = [trip["timestamps"][end][event] for trip in arrived]
        if not all("monotonic" in stamp for stamp in stamps):
            continue
        for before, after in pairwise(stamps):
            passed = int(after["monotonic"]) - int(before["monotonic"])
            step = int(after["wall"]) - int(before["wall"]) - passed
            if abs(step) > 1_000_000 + passed // 1000:  # 1 ms, and 0.1 % for a clock in adjustment
                raise BadInputError(
                    f"{name}: the clock of irtt's {end} made a step of {step * 1e-6:.4g} ms; "
                    "measure again, or take half of each round trip (--halve-rtt)"
                )


_IRTT_NAMES = {
    "halves": ("", "rtt"),
    "uplink": ("true_down", "send"),
    "downlink": ("true_up", "receive"),
}
"""What is read -> irtt's value of `lost` for packets to leave out, irtt's name of the delay."""


def _irtt_entries(
    trips: list[dict[str, Any]], what: Literal["halves", "uplink", "downlink"]
) -> list[tuple[float, float | None]]:
    """Read the time of sending and the delay of each packet [s]; time 0 is the first packet.

    Packets lost in the other direction are left out. A packet lost on the uplink never reached the
    downlink; the uplink delay of a packet lost on the downlink is unknown.

    For a packet lost on the downlink, the downlink's time of sending is estimated with the median
    uplink delay.
    """
    clock = "monotonic" if all("monotonic" in _client(trip) for trip in trips) else "wall"
    other, key = _IRTT_NAMES[what]
    median_up = 0
    if what == "downlink":
        ups = [_delay(trip, "send") for trip in trips if _lost(trip) == "false"]
        median_up = round(median([up or 0 for up in ups] or [0]))
    entries: list[tuple[int, int | None]] = []
    for trip in trips:
        if _lost(trip) == other:
            continue
        sent, delay = int(_client(trip)[clock]), _delay(trip, key)
        if what == "downlink":
            sent += median_up if delay is None else _delay(trip, "send") or 0
        entries.append((sent, delay))
    start, part = min((sent for sent, _ in entries), default=0), 0.5 if what == "halves" else 1.0
    return [
        ((sent - start) * 1e-9, None if delay is None else delay * part * 1e-9)
        for sent, delay in entries
    ]


def _client(trip: dict[str, Any]) -> dict[str, Any]:
    return dict(trip["timestamps"]["client"]["send"])


def _lost(trip: dict[str, Any]) -> str:
    return str(trip["lost"]).lower()


def _delay(trip: dict[str, Any], key: str) -> int | None:
    """Return a delay of a packet [ns]; None if it was lost."""
    return int(trip["delay"][key]) if _lost(trip) == "false" else None


def _refusal(name: str) -> BadInputError:
    """Make the error for a source that has only round trips."""
    return BadInputError(f"{name}: has round trips; {HALVE}")


SCALES = {"s": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9}
TIMES = ("time", "timestamp", "sent")
DELAYS = ("delay", "rtt")
LOSSES = ("loss", "lost")
COLUMNS = "time_s and delay_ms, or with _s, _ms, _us or _ns; rtt_ for round trips; and loss"
_LOST_WORDS = {
    *("", "-", "*", "nan", "inf", "none", "null", "na", "n/a"),
    *("lost", "loss", "timeout", "timed out", "request timed out", "no answer yet"),
}
"""Words in the delay column that mark a lost packet."""
_LOST_NUMBERS = (-1.0, -999.0, -9999.0)
"""Numbers in the delay column that mark a lost packet [unit of the column]. Such a number counts as
a mark only if the column has no other negative number."""
_FLAGS = {"0": False, "1": True, "false": False, "true": True, "no": False, "yes": True}
_LATE = {"s": 1e11, "ms": 1e14, "us": 1e17}
"""Unit -> largest plausible time since 1970, about the year 5000. A larger value means that the
true unit is finer than the column's name says."""


def _csv_rows(
    table: Table, log: Log, time: tuple[str, str], delay: str, loss: str | None
) -> tuple[list[tuple[float, float | None]], int]:
    """Read time and delay of each row, in their units, and the largest number of decimals.

    Args:
        table: The file.
        log: Collects the rows that cannot be used.
        time: Column of the time of sending, and its unit.
        delay: Column of the delay.
        loss: Column of the loss; None if there is none.
    """
    raw: list[tuple[float, float | None]] = []
    decimals = 0
    for row in table.rows():
        try:
            if row.problem:
                raise BadInputError(f"{row.where}: {row.problem}")
            sent = _csv_time(table, row, *time)
            raw.append((sent, _csv_delay(table, row, delay, loss)))
            decimals = max(decimals, decimals_of(row.cells[delay]))
        except BadInputError as error:
            log.unusable.append(str(error))
    return raw, decimals


def read_csv(lines: Iterable[str], name: str, *, halve: bool, trust_units: bool) -> Packets:
    """Read a CSV log with a header; unknown columns are skipped.

    A packet counts as lost in these cases:

    - Its delay is empty or a word for a loss, such as "timeout".
    - Its delay is -1, -999 or -9999, and the column has no other negative number.
    - Its delay is 0, all other delays are far from 0, and there is no column `loss`.
    - Its `loss` is 1. Values other than 0 and 1 are only allowed in a trace.

    Args:
        lines: Lines of the file.
        name: Name of the file, for messages.
        halve: True: use half of each round trip. False: reject round trips.
        trust_units: Whether to accept values that seem to be in another unit.

    Raises:
        BadInputError: If the log cannot be used; the text names line, value and remedy.
    """
    table, log = Table(lines, name), Log(name)
    time, time_unit = _find(table.columns, TIMES, name)
    delay, unit = _find(table.columns, DELAYS, name)
    if not unit:
        raise BadInputError(f"{name}: column {delay} does not say its unit; {_named(delay)}")
    log.halved = round_trip = delay.startswith("rtt")
    log.clocks = "the two clocks differ; synchronise them, or record round trips as rtt_ms"
    if round_trip and not halve:
        raise _refusal(f"{name}, column {delay}")
    loss = next((column for column in LOSSES if column in table.columns), None)
    raw, decimals = _csv_rows(table, log, (time, time_unit), delay, loss)
    # For nanoseconds since 1970 a float has a resolution of 256 ns, which is enough here.
    start = min((sent for sent, _ in raw), default=0.0)
    marks = _marks([value for _, value in raw if value is not None], delay, loss, decimals, log)
    scale = SCALES[unit] * (0.5 if round_trip else 1.0)
    for sent, value in raw:
        log.counts[marks.get(value, "")] += 1
        gone = value in marks
        at = (sent - start) * SCALES[time_unit or "s"]
        log.entries.append((at, None if value is None or gone else value * scale))
    del log.counts[""]
    packets = log.packets()
    if not trust_units:
        _check_unit(packets, unit, f"{name}: {delay}")
    return packets


def _check_unit(packets: Packets, unit: str, name: str) -> None:
    """Reject delays that are probably in another unit than the column says; name the other unit."""
    factor = 1 / SCALES[unit]
    top, middle = max(packets.arrived), median(packets.arrived)
    remedy = "name the column after its unit, or say --trust-units"
    if unit != "s" and 0.0 < top * factor < 1.0:
        raise BadInputError(
            f"{name} is at most {top * factor:.4g} {unit}, which looks like seconds; {remedy}"
        )
    if middle > LONGEST:
        finer = {"s": "ms", "ms": "us", "us": "ns", "ns": "ns"}[unit]
        raise BadInputError(
            f"{name} has a median of {middle * factor:.6g} {unit}, which looks like {finer}; "
            f"{remedy}"
        )


def _find(columns: list[str], kinds: tuple[str, ...], name: str) -> tuple[str, str]:
    """Find the column of one of these kinds; there must be exactly one.

    Returns:
        Name of the column, and its unit; "" without a unit.
    """
    known = {f"{kind}_{unit}": unit for kind in kinds for unit in SCALES}
    found = [column for column in columns if column in known]
    found = found or [column for column in columns if column in kinds]
    if len(found) == 1:
        return found[0], known.get(found[0], "")
    if found:
        raise BadInputError(f"{name}: has {' and '.join(found)}; keep only one of them")
    shown_columns = ",".join(columns)[:200] or "nothing"
    raise BadInputError(f"{name}: no column {kinds[0]}, found {shown_columns}; name them {COLUMNS}")


def _named(column: str) -> str:
    return f"call it {column}_s, {column}_ms, {column}_us or {column}_ns"


def _csv_time(table: Table, row: Row, column: str, unit: str) -> float:
    """Read a time in its column's unit; if the column has no unit, read date and time [s]."""
    text = row.cells[column]
    if not unit:
        try:
            return datetime.fromisoformat(text).timestamp()
        except ValueError:
            raise BadInputError(
                f"{table.name}: column {column} does not say its unit; {_named(column)}"
            ) from None
    value = table.number(text)
    if value is None or not isfinite(value):
        raise BadInputError(f"{row.where}: {column} is {shown(text)}; give a number")
    if value > _LATE.get(unit, float("inf")):
        raise BadInputError(f"{row.where}: {column} is {text}, a finer unit than {unit}; rename it")
    return value


def _csv_delay(table: Table, row: Row, column: str, loss: str | None) -> float | None:
    """Read a delay in its column's unit; None if the row says that the packet was lost."""
    if loss is not None:
        text = row.cells[loss].lower()
        flag = table.number(text)
        gone = _FLAGS.get(text, {0.0: False, 1.0: True}.get(flag) if flag is not None else None)
        if gone is None:
            raise BadInputError(
                f"{row.where}: {loss} is {shown(row.cells[loss])}; give 0 or 1 for a packet; a "
                "profile can use a trace with other shares directly"
            )
        if gone:
            return None
    text = row.cells[column]
    value = table.number(text)
    if text.lower() in _LOST_WORDS or (value is not None and isnan(value)):
        return None
    if value is None or not isfinite(value):
        raise BadInputError(f"{row.where}: {column} is {shown(text)}; give a number")
    return value


def _marks(
    values: list[float], column: str, loss: str | None, decimals: int, log: Log
) -> dict[float | None, str]:
    """Find the numbers that mark lost packets; return number -> note for the user."""
    below = {value for value in values if value < 0.0}
    marks = [value for value in below if below == {value} and value in _LOST_NUMBERS]
    if below and not marks and column.startswith("rtt"):
        raise BadInputError(
            f"{log.name}: {column} is {min(below):g}, which is no round trip; leave the cell of a "
            "lost packet empty"
        )
    if loss is None and looks_lost(set(values) - below, decimals):
        marks.append(0.0)
    return {mark: f"with {column} {mark:g} taken as lost" for mark in marks}
