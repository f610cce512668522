"""Measured delays from a file: a CSV trace goes in, a checked `Trace` in SI comes out.

The file has the header `time_s,delay_ms` or `time_s,delay_ms,loss` and one row per instant, in
rising order of time; `delay_us` may stand for `delay_ms`. Delays are one way. `read_table` takes
the same file for the distribution of its delays alone.

What became of packets sent one after the other: a log's packets go in, a trace comes out.

All sources of a trace (a run, ping, irtt, CSV) are read into this form. A packet has one way to
go: a round trip is halved before it gets here, and only if the user says so.

Logs of ping and irtt: their lines or JSON go in, packets come out.

    ping -D -i 0.2 -O HOST > ping.log
    irtt client -i 10ms -l 203 -d 1m -o irtt.json HOST

203 bytes are a datagram of telemetry; of commands, 88. ping knows round trips alone. irtt knows
both ways if the clocks of both hosts agree.

Delays from any CSV file whose columns name their units: its lines go in, packets come out.

`time_ms,delay_us,loss` is when it was sent, one way, and whether it was lost (0 or 1);
`timestamp_ns,rtt_ms` has round trips, of which half is taken if the user says so.
"""

from __future__ import annotations

import csv
import json
import re
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from itertools import pairwise
from math import fsum, isfinite, sqrt
from operator import itemgetter
from pathlib import Path
from statistics import median
from typing import Any, Literal, TypeAlias

from cloudrc.errors import BadInputError
from cloudrc.files import read
from cloudrc.link.profile import Trace

SIZE_MAX = 64 << 20
"""Longest file that is read [bytes]: half a day at 100 packets a second."""
_TIME = "time_s"
_SCALES = {"delay_ms": 1e-3, "delay_us": 1e-6}
_OPTIONAL = "loss"
_HEADER = "the header is time_s,delay_ms[,loss]"


def read_trace(path: Path, size_max: int = SIZE_MAX) -> Trace:
    """Read a trace from a CSV file.

    Args:
        path: The file.
        size_max: Longest that is read [bytes].

    Returns:
        Times [s], delays [s] and, if there is such a column, losses in [0, 1].

    Raises:
        BadInputError: If it cannot be read or is not a trace; names file, line, value and remedy.
    """
    remedy = "give a CSV file with the columns time_s,delay_ms"
    lines = read_lines(path, f"trace {path}", remedy, size_max)
    try:
        return parse_trace(lines, str(path))
    except csv.Error as error:
        raise BadInputError(f"trace {path}: {error}; give a CSV file") from None


def read_lines(path: Path, name: str, remedy: str, size_max: int = SIZE_MAX) -> list[str]:
    """Read the lines of a text file, or raise a BadInputError that says what to give instead."""
    try:
        return read(path, size_max).decode("utf-8-sig").splitlines()
    except UnicodeDecodeError:
        reason = "it is not a text file in UTF-8"
    except (OSError, ValueError) as error:
        reason = getattr(error, "strerror", None) or str(error).removeprefix(f"{path}: ")
    raise BadInputError(f"{name}: {reason}; {remedy}")


def read_table(path: Path, size_max: int = SIZE_MAX) -> tuple[float, ...]:
    """Read the distribution of a trace's delays, whenever they were; lost packets have none.

    Args:
        path: The file.
        size_max: As of `read_trace`.

    Returns:
        Shifted and scaled to mean 0 and standard deviation 1, rising, shape (n,) [1].

    Raises:
        BadInputError: As `read_trace`, and if all delays are the same.
    """
    trace = read_trace(path, size_max)
    losses = trace.losses or (0.0,) * len(trace.delays)
    delays = [delay for delay, loss in zip(trace.delays, losses, strict=True) if loss < 1.0]
    mean = fsum(delays) / max(len(delays), 1)
    deviation = sqrt(fsum((delay - mean) ** 2 for delay in delays) / max(len(delays), 1))
    if deviation <= 1e-9 * mean:
        raise BadInputError(
            f"table {path}: needs at least two different delays; give a trace with more rows, "
            "or another distribution"
        )
    return tuple(sorted((delay - mean) / deviation for delay in delays))


def parse_trace(lines: Iterable[str], name: str) -> Trace:
    """Read a trace from the lines of a CSV file.

    Args:
        lines: Header and rows; blank lines are skipped.
        name: Of the file, for messages.

    Returns:
        As `read_trace`.

    Raises:
        BadInputError: As `read_trace`.
    """
    reader = csv.DictReader(lines, skipinitialspace=True)
    columns = [column.strip() for column in reader.fieldnames or ()]
    delay_column = _check_columns(columns, name)
    reader.fieldnames = columns
    scale, with_loss = _SCALES[delay_column], _OPTIONAL in columns
    times: list[float] = []
    delays: list[float] = []
    losses: list[float] = []
    for row in reader:
        where = f"trace {name}, line {reader.line_num}"
        if None in row:
            raise BadInputError(f"{where}: more values than columns; give {len(columns)}")
        time = _number(row, _TIME, where)
        delay = _number(row, delay_column, where)
        if times and time <= times[-1]:
            raise BadInputError(
                f"{where}: time_s {time:g} does not come after {times[-1]:g}; "
                "sort the rows by time and give each instant once"
            )
        times.append(time)
        delays.append(delay * scale)
        if with_loss:
            losses.append(_number(row, _OPTIONAL, where, maximum=1.0))
    if not times:
        raise BadInputError(f"trace {name}: no rows; give at least one, for example: 0,45")
    if delay_column == "delay_ms":
        _refuse_seconds(max(delays) * 1e3, name)
    return Trace(tuple(times), tuple(delays), tuple(losses) if with_loss else None)


def _refuse_seconds(longest_ms: float, name: str) -> None:
    """Refuse a delay of 0.045 "ms": the commonest mistake, and a link that seems to do nothing."""
    if 0.0 < longest_ms < 1.0:
        raise BadInputError(
            f"trace {name}: delay_ms is {longest_ms:g} at most, which looks like seconds; "
            f"multiply by 1000, or name the column delay_us and give {longest_ms * 1e3:g}"
        )


def _check_columns(columns: list[str], name: str) -> str:
    """Refuse a header that lacks a column, or has one that would be ignored; name the delay's."""
    found = ",".join(columns) or "nothing"
    for wanted in ((_TIME,), tuple(_SCALES)):
        if not any(column in columns for column in wanted):
            missing = f"trace {name}, line 1: no column {wanted[0]}, found {found}"
            raise BadInputError(f"{missing}; {_HEADER}")
    for column in columns:
        if column not in (_TIME, *_SCALES, _OPTIONAL) or columns.count(column) > 1:
            raise BadInputError(
                f"trace {name}, line 1: column {column!r} is unknown or there twice; {_HEADER}"
            )
    given = [column for column in _SCALES if column in columns]
    if len(given) > 1:
        raise BadInputError(f"trace {name}, line 1: {' and '.join(given)}; give one of them")
    return given[0]


def _number(row: dict[str, str], column: str, where: str, maximum: float = float("inf")) -> float:
    """Read one value, at least 0, finite and at most `maximum`."""
    text = row[column]
    try:
        value = float(text)
    except (TypeError, ValueError):
        found = "nothing" if text is None else repr(text)
        raise BadInputError(f"{where}: {column} is {found}; give a number") from None
    if not 0.0 <= value < float("inf") or value > maximum:
        bounds = "from 0 to 1" if maximum == 1.0 else "that is finite and not negative"
        raise BadInputError(f"{where}: {column} is {text}; give a number {bounds}")
    return value


LONGEST = 5.0
"""Half of the delays above this [s] are more likely another unit than a network."""


@dataclass(frozen=True, slots=True)
class Packets:
    """Packets in the order in which they were sent.

    Attributes:
        sent: When each left, on any clock, strictly rising [s], shape (n,).
        delays: One way [s], None for the lost, shape (n,).
    """

    sent: tuple[float, ...]
    delays: tuple[float | None, ...]

    @property
    def arrived(self) -> list[float]:
        """Delays of those that arrived [s]."""
        return [delay for delay in self.delays if delay is not None]

    @property
    def lost(self) -> int:
        """How many did not arrive."""
        return len(self.delays) - len(self.arrived)

    @property
    def duration(self) -> float:
        """From the first to the last that was sent [s]."""
        return self.sent[-1] - self.sent[0]


def in_order(entries: Iterable[tuple[float, float | None]], name: str) -> Packets:
    """Put packets in the order of sending; of two sent at one instant the first stays.

    Args:
        entries: When sent [s] and delay [s], None if lost, in any order.
        name: Of the source, for messages.

    Raises:
        BadInputError: If none arrived, or if a delay is negative.
    """
    unique: dict[float, float | None] = {}
    for sent, delay in entries:
        unique.setdefault(sent, delay)
    ordered = sorted(unique.items(), key=itemgetter(0))
    packets = Packets(tuple(s for s, _ in ordered), tuple(d for _, d in ordered))
    arrived = packets.arrived
    if not arrived:
        raise BadInputError(f"{name}: no packet in it arrived; there is nothing to make a trace of")
    if min(arrived) < 0.0:
        raise BadInputError(
            f"{name}: a packet arrived {-min(arrived) * 1e3:.4g} ms before it was sent: the two "
            "clocks differ; synchronise them, or take half of each round trip with --halve-rtt"
        )
    return packets


def check_unit(packets: Packets, unit: str, name: str) -> None:
    """Refuse delays that look as if they were in another unit.

    Args:
        packets: As read.
        unit: That they were taken to be in: s, ms, us or ns.
        name: Of the source and its column, for messages.

    Raises:
        BadInputError: Says which unit they are likely to be in.
    """
    factor = {"s": 1.0, "ms": 1e3, "us": 1e6, "ns": 1e9}[unit]
    top, middle = max(packets.arrived), median(packets.arrived)
    remedy = "name the column after its unit, or say --trust-units"
    if unit != "s" and 0.0 < top * factor < 1.0:
        raise BadInputError(
            f"{name} is {top * factor:.4g} {unit} at most, which looks like seconds; {remedy}"
        )
    if middle > LONGEST:
        finer = {"s": "ms", "ms": "us", "us": "ns", "ns": "ns"}[unit]
        raise BadInputError(
            f"{name} is {middle * factor:.6g} {unit} in the middle, which looks like {finer}; "
            f"{remedy}"
        )


def trace_of(packets: Packets) -> Trace:
    """Make a trace that gives a stream of the same rate the same delays and losses.

    A row holds until the next, so each begins halfway between its packet and the one before: a
    replayed packet may be late or early by up to half a period and still meets its own row. Time
    begins with the first packet.

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


def write_trace(trace: Trace) -> str:
    """Write a trace as the CSV that `trace.read_trace` reads.

    Where all delays are below 1 ms the column is `delay_us`, since the reader takes such
    milliseconds for mistaken seconds.
    """
    short = 0.0 < max(trace.delays) < 1e-3
    unit, scale = ("us", 1e6) if short else ("ms", 1e3)
    lines = [f"time_s,delay_{unit}" + ",loss" * (trace.losses is not None)]
    for row, (time, delay) in enumerate(zip(trace.times, trace.delays, strict=True)):
        loss = "" if trace.losses is None else f",{trace.losses[row]:g}"
        lines.append(f"{_short(time, 9)},{_short(delay * scale, 6)}{loss}")
    return "\n".join(lines) + "\n"


def _short(value: float, digits: int) -> str:
    """Write a number with at most so many decimals, none of them a zero at the end."""
    return f"{value:.{digits}f}".rstrip("0").rstrip(".")


Direction: TypeAlias = Literal["uplink", "downlink"]

_STAMP = re.compile(r"\[(\d+(?:\.\d+)?)\] ")
_REPLY = re.compile(r"icmp_seq=(\d{1,12}) .*\btime[=<](\d+(?:\.\d+)?) ms")
_WRAP = 1 << 16
_PACKETS_MAX = 10_000_000
"""More than ping sends in three weeks at five a second; forged numbers would fill the memory."""
_MISSHAPEN = ArithmeticError, AttributeError, LookupError, RecursionError, TypeError, ValueError
"""What JSON of any other shape raises."""
_HALVE = (
    "a trace is one way; if both directions are alike, take half of each round trip with "
    "--halve-rtt, else measure one way with irtt between synchronised clocks"
)


class _NoStampsError(Exception):
    """A log of irtt without one-way delays."""


def is_ping(lines: Iterable[str]) -> bool:
    """Say whether a text looks like the output of ping."""
    return any("icmp_seq=" in line or line.startswith("PING ") for line in lines)


def read_ping(lines: Iterable[str], name: str, *, halve: bool) -> Packets:
    """Read what `ping -D` printed.

    A reply is stamped when it arrived. Sequence numbers without a reply are lost packets, those
    after the last reply excepted: they may have been under way. Source: ping(8) of iputils.

    Args:
        lines: Of the log; what is no reply is skipped.
        name: Of the file, for messages.
        halve: Whether to take half of each round trip; it is refused else.

    Returns:
        Packets, half a round trip each.

    Raises:
        BadInputError: If there are no replies or no stamps, or too many packets between the first
            and the last, or if `halve` is not set.
    """
    if not halve:
        raise BadInputError(f"{name}: ping measures round trips; {_HALVE}")
    replies = dict(_replies(lines, name))
    if not replies:
        raise BadInputError(f"{name}: no replies in it; give the output of: ping -D HOST")
    first, last = min(replies), max(replies)
    if last - first >= _PACKETS_MAX:
        raise BadInputError(
            f"{name}: its numbers span {last - first + 1} packets, more than {_PACKETS_MAX}; "
            "give the output of one ping"
        )
    period = (replies[last][0] - replies[first][0]) / max(last - first, 1)
    entries: list[tuple[float, float | None]] = []
    sent = replies[first][0] - period
    for number in range(first, last + 1):
        if number in replies:
            sent, round_trip = replies[number]
            entries.append((sent, round_trip / 2))
        else:
            sent += period
            entries.append((sent, None))
    return in_order(entries, name)


def _replies(lines: Iterable[str], name: str) -> Iterator[tuple[int, tuple[float, float]]]:
    """Find each reply's number, counted on where ping begins anew, its instant and round trip."""
    turns, newest = 0, 0
    seen = set()
    for line in lines:
        reply = _REPLY.search(line)
        if reply is None or "DUP!" in line:
            continue
        stamp = _STAMP.match(line)
        if stamp is None:
            raise BadInputError(f"{name}: its lines have no [time]; run ping with -D")
        # ping counts to 65535 and on from 0; what comes late may be of the turn before.
        number = int(reply[1]) + turns * _WRAP
        if newest - number > _WRAP // 2:
            turns, number = turns + 1, number + _WRAP
        elif number - newest > _WRAP // 2 and turns:
            number -= _WRAP
        newest = max(newest, number)
        if number not in seen:
            seen.add(number)
            round_trip = float(reply[2]) * 1e-3
            yield number, (float(stamp[1]) - round_trip, round_trip)


def read_irtt(text: str, name: str, direction: Direction, *, halve: bool) -> Packets:
    """Read what `irtt client -o FILE.json` wrote.

    The client is taken for the robot: what it sends is the uplink. A packet of which irtt says
    only that it is lost, not which way, counts as lost in both.

    Source: irtt-client(1), JSON format 1.

    Args:
        text: Of the file.
        name: Of the file, for messages.
        direction: Which of the two to take.
        halve: Whether to take half of each round trip in place of the one-way delay.

    Raises:
        BadInputError: If it is no such file, or if it has no one-way delays and `halve` is not set.
    """
    try:
        trips = json.loads(text)["round_trips"]
        if halve:
            entries = [(_sent(trip), _delay(trip, "rtt")) for trip in trips]
        else:
            entries = _one_way(trips, direction)
        start, half = min(sent for sent, _ in entries), 0.5 if halve else 1.0
        return in_order(
            (
                ((sent - start) * 1e-9, None if delay is None else delay * half * 1e-9)
                for sent, delay in entries
            ),
            name,
        )
    except _NoStampsError:
        raise refusal(f"{name} (irtt's server sent no stamps)") from None
    except _MISSHAPEN as error:
        raise BadInputError(
            f"{name}: not a log of irtt ({type(error).__name__}: {error}); "
            "give the file that 'irtt client -o FILE.json' writes"
        ) from None


def _one_way(trips: list[dict[str, Any]], direction: Direction) -> list[tuple[int, int | None]]:
    """Read one direction: when each packet left and its delay [ns].

    What was lost in the other direction is left out: the downlink never saw it, or how late it was
    on the uplink is not known. When a packet that was lost on its way down had left is taken from
    the middle of the uplink's delays.
    """
    if direction == "uplink":
        kept = [trip for trip in trips if _lost(trip) != "true_down"]
        return [(_sent(trip), _delay(trip, "send")) for trip in kept]
    up = median([_delay(trip, "send") or 0 for trip in trips if _lost(trip) == "false"] or [0])
    entries: list[tuple[int, int | None]] = []
    for trip in trips:
        delay = _delay(trip, "receive")
        if delay is not None:
            entries.append((int(trip["timestamps"]["client"]["receive"]["wall"]) - delay, delay))
        elif _lost(trip) != "true_up":
            entries.append((_sent(trip) + round(up), None))
    return entries


def _sent(trip: dict[str, Any]) -> int:
    return int(trip["timestamps"]["client"]["send"]["wall"])


def _lost(trip: dict[str, Any]) -> str:
    return str(trip["lost"]).lower()


def _delay(trip: dict[str, Any], key: str) -> int | None:
    """Look a delay up [ns]; None if the packet was lost."""
    if _lost(trip) != "false":
        return None
    if key not in trip["delay"]:
        raise _NoStampsError
    return int(trip["delay"][key])


def refusal(name: str) -> BadInputError:
    """Say that a source has round trips alone."""
    return BadInputError(f"{name}: has round trips; {_HALVE}")


SCALES = {"s": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9}
TIMES = ("time", "timestamp", "sent")
DELAYS = ("delay", "rtt")
LOSSES = ("loss", "lost")
COLUMNS = "time_s and delay_ms, or with _s, _ms, _us or _ns; rtt_ for round trips; and loss"
_NONE = ("", "nan", "none", "null", "-")
_LATE = {"s": 1e11, "ms": 1e14, "us": 1e17}
"""A time since 1970 above this is in a finer unit: it would be after the year 5000."""


def read_csv(lines: Iterable[str], name: str, *, halve: bool, trust_units: bool) -> Packets:
    """Read a CSV file with a header; other columns than those named are skipped.

    A packet is lost if its delay is empty or not a number, or if `loss` is 1; other shares of loss
    belong into a trace that a profile reads as it stands.

    Args:
        lines: Of the file.
        name: Of the file, for messages.
        halve: Whether to take half of each round trip; without it round trips are refused.
        trust_units: Whether to take values that look like another unit all the same.

    Raises:
        BadInputError: Names line, value and remedy.
    """
    reader = csv.DictReader((line for line in lines if line.strip()), skipinitialspace=True)
    try:
        columns = [column.strip() for column in reader.fieldnames or ()]
        reader.fieldnames = columns
        time, time_unit = _find(columns, TIMES, name)
        delay, unit = _find(columns, DELAYS, name)
        round_trip = delay.startswith("rtt")
        if round_trip and not halve:
            raise refusal(f"{name}, column {delay}")
        loss = next((column for column in LOSSES if column in columns), None)
        scale = SCALES[unit] * (0.5 if round_trip else 1.0)
        rows = [
            _row(row, (time, time_unit), (delay, scale), loss, f"{name}, line {reader.line_num}")
            for row in reader
        ]
    except csv.Error as error:
        raise BadInputError(f"{name}: {error}; give a CSV file") from None
    # Of nanoseconds since 1970 a float keeps every 256th, which is near enough for an instant.
    start = rows[0][0] if rows else 0.0
    packets = in_order([((at - start) * SCALES[time_unit], value) for at, value in rows], name)
    if not trust_units:
        check_unit(packets, unit, f"{name}: {delay}")
    return packets


def _find(columns: list[str], kinds: tuple[str, ...], name: str) -> tuple[str, str]:
    """Find the one column of these kinds, and its unit."""
    known = {f"{kind}_{unit}": unit for kind in kinds for unit in SCALES}
    found = [column for column in columns if column in known]
    bare = [column for column in columns if column in kinds]
    if len(found) == 1 and columns.count(found[0]) == 1:
        return found[0], known[found[0]]
    if found:
        raise BadInputError(f"{name}: has {' and '.join(found)}; leave one of them")
    if bare:
        raise BadInputError(
            f"{name}: column {bare[0]} does not say its unit; call it {bare[0]}_s, {bare[0]}_ms, "
            f"{bare[0]}_us or {bare[0]}_ns"
        )
    raise BadInputError(
        f"{name}: no column {kinds[0]}, found {','.join(columns) or 'nothing'}; name them {COLUMNS}"
    )


def _row(
    row: dict[str, str], time: tuple[str, str], delay: tuple[str, float], loss: str | None, at: str
) -> tuple[float, float | None]:
    """Read one line: its time in its own unit, and its delay [s] or None if it was lost."""
    name, unit = time
    sent = _csv_number(row.get(name), name, at)
    if sent > _LATE.get(unit, float("inf")):
        raise BadInputError(f"{at}: {name} is {row[name]}, a finer unit than {unit}; rename it")
    gone = loss is not None and _csv_number(row.get(loss), loss, at)
    if gone not in (0, 1):
        raise BadInputError(
            f"{at}: {loss} is {row[str(loss)]}; give 0 or 1 for a packet; a trace with shares is "
            "read by a profile as it stands"
        )
    text = row.get(delay[0])
    if gone or text is None or text.strip().lower() in _NONE:
        return sent, None
    return sent, _csv_number(text, delay[0], at) * delay[1]


def _csv_number(text: str | None, column: str, at: str) -> float:
    try:
        value = float(text if text is not None else "")
    except ValueError:
        found = "nothing" if not text else repr(text)
        raise BadInputError(f"{at}: {column} is {found}; give a number") from None
    if not isfinite(value):
        raise BadInputError(f"{at}: {column} is {text}; give a number")
    return value
