"""Measured delays from a file: a CSV trace goes in, a checked `Trace` in SI comes out.

The file has the header `time_s,delay_ms` or `time_s,delay_ms,loss` and one row per instant, in
rising order of time. Delays are one way.
"""

from __future__ import annotations

import csv
from collections.abc import Iterable
from pathlib import Path

from cloudrc.errors import BadInputError
from cloudrc.link.profile import Trace

_REQUIRED = ("time_s", "delay_ms")
_OPTIONAL = "loss"


def read_trace(path: Path) -> Trace:
    """Read a trace from a CSV file.

    Args:
        path: The file.

    Returns:
        Times [s], delays [s] and, if there is such a column, losses in [0, 1].

    Raises:
        BadInputError: If it cannot be read or is not a trace; names file, line, value and remedy.
    """
    try:
        text = path.read_text(encoding="utf-8-sig")
    except (OSError, UnicodeDecodeError) as error:
        reason = getattr(error, "strerror", None) or "it is not a text file in UTF-8"
        raise BadInputError(
            f"trace {path}: {reason}; give a CSV file with the columns time_s,delay_ms[,loss]"
        ) from None
    try:
        return parse_trace(text.splitlines(), str(path))
    except csv.Error as error:
        raise BadInputError(f"trace {path}: {error}; give a CSV file") from None


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
    _check_columns(columns, name)
    reader.fieldnames = columns
    with_loss = _OPTIONAL in columns
    times: list[float] = []
    delays: list[float] = []
    losses: list[float] = []
    for row in reader:
        where = f"trace {name}, line {reader.line_num}"
        if None in row:
            raise BadInputError(f"{where}: more values than columns; give {len(columns)}")
        time = _number(row, "time_s", where)
        delay = _number(row, "delay_ms", where)
        if times and time <= times[-1]:
            raise BadInputError(
                f"{where}: time_s {time:g} does not come after {times[-1]:g}; "
                "sort the rows by time and give each instant once"
            )
        times.append(time)
        delays.append(delay * 1e-3)
        if with_loss:
            losses.append(_number(row, _OPTIONAL, where, maximum=1.0))
    if not times:
        raise BadInputError(f"trace {name}: no rows; give at least one, for example: 0,45")
    return Trace(tuple(times), tuple(delays), tuple(losses) if with_loss else None)


def _check_columns(columns: list[str], name: str) -> None:
    """Refuse a header that lacks a column, or has one that would be ignored."""
    for column in _REQUIRED:
        if column not in columns:
            found = ",".join(columns) or "nothing"
            raise BadInputError(
                f"trace {name}, line 1: no column {column}, found {found}; "
                "the header is time_s,delay_ms[,loss]"
            )
    for column in columns:
        if column not in (*_REQUIRED, _OPTIONAL) or columns.count(column) > 1:
            raise BadInputError(
                f"trace {name}, line 1: column {column!r} is unknown or there twice; "
                "the header is time_s,delay_ms[,loss]"
            )


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
