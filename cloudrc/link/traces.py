"""Read measured delays from files and make traces of them.

`read_trace` reads a trace: a CSV file with the header `time_s,delay_ms` or `time_s,delay_ms,loss`
and one row per instant, in rising order of time; `delay_us` may replace `delay_ms`. Delays are one
way. `read_table` reads only the distribution of the delays from such a file.

`read_ping`, `read_irtt` and `read_csv` read logs as `Packets`, from which `trace_of` makes a trace:

    ping -D -i 0.2 -O HOST > ping.log
    irtt client -i 10ms -l 203 -d 1m -o irtt.json HOST

A telemetry datagram has 203 bytes, a command 88. ping measures only round trips, of which half is
used if the user asks for it. irtt measures both directions if the hosts' clocks agree. The columns
of a CSV log name their units: `time_ms,delay_us,loss` are the time of sending, the one-way delay
and the loss (0 or 1); `timestamp_ns,rtt_ms` has round trips.
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
"""Size limit of a file [bytes]: half a day at 100 packets a second."""
_TIME = "time_s"
_SCALES = {"delay_ms": 1e-3, "delay_us": 1e-6}
_OPTIONAL = "loss"
_HEADER = "the header is time_s,delay_ms[,loss]"


def read_trace(path: Path, size_max: int = SIZE_MAX) -> Trace:
    """Read a trace from a CSV file.

    Args:
        path: The file.
        size_max: Size limit of the file [bytes].

    Returns:
        Times [s], delays [s] and, if the file has the column, losses in [0, 1].

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
    """Read the lines of a text file; raise a BadInputError with the remedy if that fails."""
    try:
        return read(path, size_max).decode("utf-8-sig").splitlines()
    except UnicodeDecodeError:
        reason = "it is not a text file in UTF-8"
    except (OSError, ValueError) as error:
        reason = getattr(error, "strerror", None) or str(error).removeprefix(f"{path}: ")
    raise BadInputError(f"{name}: {reason}; {remedy}")


def read_table(path: Path, size_max: int = SIZE_MAX) -> tuple[float, ...]:
    """Read the distribution of a trace's delays, without lost packets.

    Args:
        path: The file.
        size_max: Size limit of the file [bytes].

    Returns:
        The delays, shifted and scaled to mean 0 and standard deviation 1, rising, shape (n,) [1].

    Raises:
        BadInputError: As `read_trace`, and if all delays are equal.
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
        name: Name of the file, for messages.

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
                "sort the rows by time and give each time once"
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
    """Reject delays that are in seconds, the most common mistake: the link would seem ideal."""
    if 0.0 < longest_ms < 1.0:
        raise BadInputError(
            f"trace {name}: delay_ms is at most {longest_ms:g}, which looks like seconds; "
            f"multiply by 1000, or name the column delay_us and give {longest_ms * 1e3:g}"
        )


def _check_columns(columns: list[str], name: str) -> str:
    """Check a header; reject missing, unknown and repeated columns; return the delay's column."""
    found = ",".join(columns) or "nothing"
    for wanted in ((_TIME,), tuple(_SCALES)):
        if not any(column in columns for column in wanted):
            missing = f"trace {name}, line 1: no column {wanted[0]}, found {found}"
            raise BadInputError(f"{missing}; {_HEADER}")
    for column in columns:
        if column not in (_TIME, *_SCALES, _OPTIONAL) or columns.count(column) > 1:
            raise BadInputError(
                f"trace {name}, line 1: column {column!r} is unknown or repeated; {_HEADER}"
            )
    given = [column for column in _SCALES if column in columns]
    if len(given) > 1:
        raise BadInputError(f"trace {name}, line 1: {' and '.join(given)}; give one of them")
    return given[0]


def _number(row: dict[str, str], column: str, where: str, maximum: float = float("inf")) -> float:
    """Parse a value that is finite, at least 0 and at most `maximum`."""
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
"""Longest plausible median delay [s]; above it the values are probably in another unit."""


@dataclass(frozen=True, slots=True)
class Packets:
    """The packets of a log in the order of sending.

    Attributes:
        sent: When each was sent, on any clock, strictly rising [s], shape (n,).
        delays: One way [s], None for lost packets, shape (n,).
    """

    sent: tuple[float, ...]
    delays: tuple[float | None, ...]

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


def in_order(entries: Iterable[tuple[float, float | None]], name: str) -> Packets:
    """Sort packets by the time of sending; of packets with the same time keep the first.

    Args:
        entries: Time of sending [s] and delay [s] (None if lost), in any order.
        name: Name of the source, for messages.

    Raises:
        BadInputError: If no packet arrived, or a delay is negative.
    """
    unique: dict[float, float | None] = {}
    for sent, delay in entries:
        unique.setdefault(sent, delay)
    ordered = sorted(unique.items(), key=itemgetter(0))
    packets = Packets(tuple(s for s, _ in ordered), tuple(d for _, d in ordered))
    arrived = packets.arrived
    if not arrived:
        raise BadInputError(f"{name}: no packet arrived; give a log with at least one reply")
    if min(arrived) < 0.0:
        raise BadInputError(
            f"{name}: a packet arrived {-min(arrived) * 1e3:.4g} ms before it was sent: the two "
            "clocks differ; synchronise them, or take half of each round trip with --halve-rtt"
        )
    return packets


def check_unit(packets: Packets, unit: str, name: str) -> None:
    """Reject delays that are probably in another unit.

    Args:
        packets: The packets of a log.
        unit: Unit in which the delays were read: s, ms, us or ns.
        name: Name of the source and its column, for messages.

    Raises:
        BadInputError: If the delays are implausible; names the probable unit.
    """
    factor = {"s": 1.0, "ms": 1e3, "us": 1e6, "ns": 1e9}[unit]
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


def trace_of(packets: Packets) -> Trace:
    """Make a trace that gives a stream of the same rate the same delays and losses.

    Each row begins halfway between its packet and the packet before. So a replayed packet may be
    late or early by half a period and still gets its own row. Time begins at the first packet.

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
    """Format a trace as the CSV that `read_trace` reads.

    If all delays are below 1 ms, the column is `delay_us`, since the reader would reject such
    milliseconds as seconds.
    """
    short = 0.0 < max(trace.delays) < 1e-3
    unit, scale = ("us", 1e6) if short else ("ms", 1e3)
    lines = [f"time_s,delay_{unit}" + ",loss" * (trace.losses is not None)]
    for row, (time, delay) in enumerate(zip(trace.times, trace.delays, strict=True)):
        loss = "" if trace.losses is None else f",{trace.losses[row]:g}"
        lines.append(f"{_short(time, 9)},{_short(delay * scale, 6)}{loss}")
    return "\n".join(lines) + "\n"


def _short(value: float, digits: int) -> str:
    """Format a number with at most `digits` decimals, without trailing zeros."""
    return f"{value:.{digits}f}".rstrip("0").rstrip(".")


Direction: TypeAlias = Literal["uplink", "downlink"]

_STAMP = re.compile(r"\[(\d+(?:\.\d+)?)\] ")
_REPLY = re.compile(r"icmp_seq=(\d{1,12}) .*\btime[=<](\d+(?:\.\d+)?) ms")
_WRAP = 1 << 16
_PACKETS_MAX = 10_000_000
"""Limit of packets in a log of ping, three weeks at five a second, since a number may be forged."""
_MISSHAPEN = ArithmeticError, AttributeError, LookupError, RecursionError, TypeError, ValueError
"""Errors that JSON of another layout can raise."""
_HALVE = (
    "a trace is one way; if both directions are alike, use half of each round trip with "
    "--halve-rtt; otherwise measure one way with irtt between synchronised clocks"
)


class _NoStampsError(Exception):
    """A log of irtt has no one-way delays."""


def is_ping(lines: Iterable[str]) -> bool:
    """Check whether a text looks like the output of ping."""
    return any("icmp_seq=" in line or line.startswith("PING ") for line in lines)


def read_ping(lines: Iterable[str], name: str, *, halve: bool) -> Packets:
    """Read the output of `ping -D`.

    Its stamp is the time of a reply's arrival. Sequence numbers without a reply are lost packets,
    except after the last reply, where replies may have been on their way.

    Source: ping(8) of iputils.

    Args:
        lines: Lines of the log; those without a reply are skipped.
        name: Name of the file, for messages.
        halve: Whether to use half of each round trip; it must be true.

    Returns:
        Packets with half a round trip as delay.

    Raises:
        BadInputError: If there are no replies, no stamps or too many packets, or `halve` is false.
    """
    if not halve:
        raise BadInputError(f"{name}: ping measures round trips; {_HALVE}")
    replies = dict(_replies(lines, name))
    if not replies:
        raise BadInputError(f"{name}: has no replies; give the output of: ping -D HOST")
    first, last = min(replies), max(replies)
    if last - first >= _PACKETS_MAX:
        raise BadInputError(
            f"{name}: its sequence numbers span {last - first + 1} packets, more than "
            f"{_PACKETS_MAX}; give the output of one ping"
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
    """Yield the number, the time of sending and the round trip of each reply.

    ping's 16-bit sequence number is unwrapped.
    """
    wraps, newest = 0, 0
    seen = set()
    for line in lines:
        reply = _REPLY.search(line)
        if reply is None or "DUP!" in line:
            continue
        stamp = _STAMP.match(line)
        if stamp is None:
            raise BadInputError(f"{name}: its lines have no [time]; run ping with -D")
        # After 65535 ping continues with 0; a late reply may be from before that.
        number = int(reply[1]) + wraps * _WRAP
        if newest - number > _WRAP // 2:
            wraps, number = wraps + 1, number + _WRAP
        elif number - newest > _WRAP // 2 and wraps:
            number -= _WRAP
        newest = max(newest, number)
        if number not in seen:
            seen.add(number)
            round_trip = float(reply[2]) * 1e-3
            yield number, (float(stamp[1]) - round_trip, round_trip)


def read_irtt(text: str, name: str, direction: Direction, *, halve: bool) -> Packets:
    """Read the output of `irtt client -o FILE.json`.

    The client stands for the robot: what it sends is the uplink. A packet that irtt reports as
    lost without the direction counts as lost in both.

    Source: irtt-client(1), JSON format 1.

    Args:
        text: Content of the file.
        name: Name of the file, for messages.
        direction: Direction to read.
        halve: Whether to use half of each round trip instead of the one-way delay.

    Raises:
        BadInputError: If it is not such a file, or has no one-way delays and `halve` is false.
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
    """Read the time of sending and the delay of each packet of one direction [ns].

    Packets lost in the other direction are left out: they never reached the downlink, or their
    uplink delay is unknown. For a packet lost on the downlink, the time of sending is estimated
    with the median uplink delay.
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
    """Return a delay of a packet [ns]; None if it was lost."""
    if _lost(trip) != "false":
        return None
    if key not in trip["delay"]:
        raise _NoStampsError
    return int(trip["delay"][key])


def refusal(name: str) -> BadInputError:
    """Make the error for a source that has only round trips."""
    return BadInputError(f"{name}: has round trips; {_HALVE}")


SCALES = {"s": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9}
TIMES = ("time", "timestamp", "sent")
DELAYS = ("delay", "rtt")
LOSSES = ("loss", "lost")
COLUMNS = "time_s and delay_ms, or with _s, _ms, _us or _ns; rtt_ for round trips; and loss"
_NONE = ("", "nan", "none", "null", "-")
_LATE = {"s": 1e11, "ms": 1e14, "us": 1e17}
"""Largest plausible time since 1970 by its unit, about the year 5000; above it the unit is finer
than the column says."""


def read_csv(lines: Iterable[str], name: str, *, halve: bool, trust_units: bool) -> Packets:
    """Read a CSV log with a header; unknown columns are skipped.

    A packet is lost if its delay is empty or no number, or if `loss` is 1. Other values of `loss`
    are only allowed in a trace (`read_trace`).

    Args:
        lines: Lines of the file.
        name: Name of the file, for messages.
        halve: Whether to use half of each round trip; if false, round trips are rejected.
        trust_units: Whether to accept values that look like another unit.

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
    # For nanoseconds since 1970 a float has a resolution of 256 ns, which is enough here.
    start = rows[0][0] if rows else 0.0
    packets = in_order([((at - start) * SCALES[time_unit], value) for at, value in rows], name)
    if not trust_units:
        check_unit(packets, unit, f"{name}: {delay}")
    return packets


def _find(columns: list[str], kinds: tuple[str, ...], name: str) -> tuple[str, str]:
    """Find the only column of these kinds; return its name and unit."""
    known = {f"{kind}_{unit}": unit for kind in kinds for unit in SCALES}
    found = [column for column in columns if column in known]
    bare = [column for column in columns if column in kinds]
    if len(found) == 1 and columns.count(found[0]) == 1:
        return found[0], known[found[0]]
    if found:
        raise BadInputError(f"{name}: has {' and '.join(found)}; keep only one of them")
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
    """Parse one line: its time in the column's unit and its delay [s], None if it was lost."""
    name, unit = time
    sent = _csv_number(row.get(name), name, at)
    if sent > _LATE.get(unit, float("inf")):
        raise BadInputError(f"{at}: {name} is {row[name]}, a finer unit than {unit}; rename it")
    gone = loss is not None and _csv_number(row.get(loss), loss, at)
    if gone not in (0, 1):
        raise BadInputError(
            f"{at}: {loss} is {row[str(loss)]}; give 0 or 1 for a packet; a profile can use a "
            "trace with other shares directly"
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
