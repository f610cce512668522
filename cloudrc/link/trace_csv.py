"""Delays from any CSV file whose columns name their units: its lines go in, packets come out.

`time_ms,delay_us,loss` is when it was sent, one way, and whether it was lost (0 or 1);
`timestamp_ns,rtt_ms` has round trips, of which half is taken if the user says so.
"""

from __future__ import annotations

import csv
from collections.abc import Iterable
from math import isfinite

from cloudrc.errors import BadInputError
from cloudrc.link.trace_logs import refusal
from cloudrc.link.trace_packets import Packets, check_unit, in_order

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
    sent = _number(row.get(name), name, at)
    if sent > _LATE.get(unit, float("inf")):
        raise BadInputError(f"{at}: {name} is {row[name]}, a finer unit than {unit}; rename it")
    gone = loss is not None and _number(row.get(loss), loss, at)
    if gone not in (0, 1):
        raise BadInputError(
            f"{at}: {loss} is {row[str(loss)]}; give 0 or 1 for a packet; a trace with shares is "
            "read by a profile as it stands"
        )
    text = row.get(delay[0])
    if gone or text is None or text.strip().lower() in _NONE:
        return sent, None
    return sent, _number(text, delay[0], at) * delay[1]


def _number(text: str | None, column: str, at: str) -> float:
    try:
        value = float(text if text is not None else "")
    except ValueError:
        found = "nothing" if not text else repr(text)
        raise BadInputError(f"{at}: {column} is {found}; give a number") from None
    if not isfinite(value):
        raise BadInputError(f"{at}: {column} is {text}; give a number")
    return value
