"""Measured delays from a file: a CSV trace goes in, a checked `Trace` in SI comes out.

The file has the header `time_s,delay_ms` or `time_s,delay_ms,loss` and one row per instant, in
rising order of time; `delay_us` may stand for `delay_ms`. Delays are one way. `read_table` takes
the same file for the distribution of its delays alone.
"""

from __future__ import annotations

import csv
from collections.abc import Iterable
from math import fsum, sqrt
from pathlib import Path

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
