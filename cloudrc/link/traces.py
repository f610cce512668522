"""Read and write traces: CSV files of delay and loss over time, which link profiles use.

A trace has the header `time_s,delay_ms` or `time_s,delay_ms,loss`, and one row per instant in
rising order of time; `delay_us` may replace `delay_ms`. Delays are one way. `link/logs.py` converts
the logs of other tools to traces.
"""

from __future__ import annotations

import csv
import re
from collections.abc import Iterable, Iterator, Sequence
from contextlib import AbstractContextManager
from dataclasses import fields
from functools import lru_cache
from math import fsum, inf, sqrt
from pathlib import Path
from typing import Any, NamedTuple

from cloudrc.errors import BadInputError
from cloudrc.files import read, version
from cloudrc.link.profile import (
    Blackout,
    Change,
    DirectionKeys,
    DirectionProfile,
    GilbertElliott,
    Trace,
)
from cloudrc.outside.patience import telling_if_slow
from cloudrc.outside.values import ANY, InvalidValueError, Quantity
from cloudrc.rounding import differences

SIZE_MAX = 64 << 20  # size limit of a file [bytes]: half a day at 100 packets a second
START_MAX = 600.0  # if the first row is later, times count from the first row [s]
LATEST = 1e11  # largest plausible time since 1970 [s]; a larger time has another unit
NO_HEADER = (
    "the first line must be time_s,delay_ms; a rate trace of mahimahi has no delays, use rate_kbit"
)
"""What to do about a file of numbers without a header."""
SILENT = 1.0  # time after which a command says that it reads a large file [s]
_GZIP = b"\x1f\x8b"  # first bytes of a compressed file (RFC 1952)
_SCALES = {"delay_ms": 1e-3, "delay_us": 1e-6}


def read_trace(path: Path, size_max: int = SIZE_MAX) -> Trace:
    """Read a trace from a CSV file of at most `size_max` bytes; an unchanged file is read once.

    Raises:
        BadInputError: If the file cannot be read or is no trace; the text names file, line, value
            and remedy.
    """
    return _read_trace(path, size_max, version(path))


@lru_cache(maxsize=4)  # of both directions: a large trace takes seconds
def _read_trace(path: Path, size_max: int, state: object) -> Trace:
    """Read a trace; `state` changes with the file."""
    remedy = "give a CSV file with the columns time_s,delay_ms"
    lines = read_lines(path, f"trace {path}", remedy, size_max)
    with telling_rows(path, lines):
        return parse_trace(lines, str(path))


def telling_rows(path: Path, lines: Sequence[str]) -> AbstractContextManager[None]:
    """Say while the block reads the lines of a file how many they are, if that takes long."""
    return telling_if_slow(f"reads {path}: {len(lines) - 1:,} rows", SILENT)


def link_profile(direction: DirectionKeys, file_max: int = SIZE_MAX) -> DirectionProfile:
    """Read the files that one direction of a link profile names.

    Raise a BadInputError if a file cannot be used or is longer than `file_max` bytes.
    """
    table = direction.distribution == "table" and direction.table
    return DirectionProfile(
        **{key.name: _plain(getattr(direction, key.name)) for key in fields(DirectionKeys)},
        rows=read_trace(Path(direction.trace), file_max) if direction.trace else None,
        quantiles=read_table(Path(table), file_max) if table else (),
    )


def _plain(value: Any) -> Any:
    """Return a value of a profile with the plain classes in place of those of the schema."""
    if isinstance(value, tuple):
        return tuple(_plain(one) for one in value)
    for kind in (GilbertElliott, Blackout, Change):
        if isinstance(value, kind):
            return kind(**{key.name: _plain(getattr(value, key.name)) for key in fields(kind)})
    return value


def read_lines(path: Path, name: str, remedy: str, size_max: int = SIZE_MAX) -> list[str]:
    """Read the lines of a text file; if that fails, raise a BadInputError with a remedy.

    `remedy` is that of all failures but a file which is compressed with gzip, as irtt writes it.

    Accepted encodings are UTF-8, UTF-16 with a byte order mark (Windows writes it if output is
    redirected), and one byte per character.
    """
    try:
        data = read(path, size_max)
        if data.startswith(_GZIP):
            raise BadInputError(f"{name}: is compressed with gzip; unpack it first with gunzip")
        return _decode(data)
    except (OSError, ValueError) as error:
        reason = getattr(error, "strerror", None) or str(error).removeprefix(f"{path}: ")
    raise BadInputError(f"{name}: {reason}; {remedy}")


def _decode(data: bytes) -> list[str]:
    if data[:2] in (b"\xff\xfe", b"\xfe\xff"):
        return data.decode("utf-16", "replace").splitlines()
    if b"\0" in data:
        raise ValueError("it is not a text file")
    try:
        return data.decode("utf-8-sig").splitlines()
    except UnicodeDecodeError:
        return data.decode("latin-1").splitlines()


def read_table(path: Path, size_max: int = SIZE_MAX) -> tuple[float, ...]:
    """Read the distribution of a trace's delays, without lost packets.

    Return the delays, shifted and scaled to mean 0 and standard deviation 1, rising, shape (n,).
    Raise a BadInputError if the file is no trace, or has fewer than two different delays.
    """
    trace = read_trace(path, size_max)
    losses = trace.losses or (0.0,) * len(trace.delays)
    delays = [delay for delay, loss in zip(trace.delays, losses, strict=True) if loss < 1.0]
    mean = fsum(delays) / max(len(delays), 1)
    deviation = sqrt(fsum((delay - mean) ** 2 for delay in delays) / max(len(delays), 1))
    if not delays or not differences(min(delays), max(delays)):
        raise BadInputError(
            f"table {path}: needs at least two different delays; give a trace with more rows, "
            "or another distribution"
        )
    return tuple(sorted((delay - mean) / deviation for delay in delays))


def parse_trace(lines: Iterable[str], name: str) -> Trace:
    """Parse the lines of the trace file `name`; raise a BadInputError if they are no trace.

    If the first row's time is above `START_MAX` [s], subtract this time from all times.
    """
    place = f"trace {name}"
    columns, rows = read_rows(lines, place)
    delay = next((column for column in columns if column in _SCALES), "delay_ms")
    if sorted(columns) not in (sorted(["time_s", delay]), sorted(["time_s", delay, "loss"])):
        raise BadInputError(
            f"{place}, line 1: the columns are {','.join(columns)[:200] or 'missing'}; the header "
            "is time_s,delay_ms or time_s,delay_us, and may end in ,loss"
        )
    wanted = ["time_s", delay, "loss"][: len(columns)]
    found = _rising(rows, wanted)
    if not found:
        raise BadInputError(f"{place}: no rows; give at least one, for example: 0,45")
    times, delays, *losses = zip(*found, strict=True)
    if times[0] > LATEST:
        raise BadInputError(f"{place}: time_s begins at {times[0]:.15g}, which is not in seconds")
    start = times[0] if times[0] > START_MAX else 0.0
    scaled = tuple(one * _SCALES[delay] for one in delays)
    return Trace(tuple(time - start for time in times), scaled, losses[0] if losses else None)


def _rising(rows: Iterable[Row], columns: Sequence[str]) -> list[list[float]]:
    """Read the numbers of `columns` in each row; the first column is a time, which has to rise."""
    found = list[list[float]]()
    for row in rows:
        found.append([_number(row, column) for column in columns])
        if len(found) > 1 and found[-1][0] <= found[-2][0]:
            raise BadInputError(
                f"{row.where}: time_s {found[-1][0]:.12g} does not come after "
                f"{found[-2][0]:.12g}; sort the rows by time and give each time once"
            )
    return found


def write_trace(trace: Trace) -> str:
    """Format a trace as a CSV text that `read_trace` can read."""
    lines = ["time_s,delay_ms" + ",loss" * (trace.losses is not None)]
    for row, (time, delay) in enumerate(zip(trace.times, trace.delays, strict=True)):
        loss = "" if trace.losses is None else f",{trace.losses[row]:g}"
        lines.append(f"{_short(time, 9)},{_short(delay * 1e3, 6)}{loss}")
    return "\n".join(lines) + "\n"


def _short(value: float, digits: int) -> str:
    return f"{value:.{digits}f}".rstrip("0").rstrip(".")


class Row(NamedTuple):
    """One row of a trace or log in a CSV file."""

    where: str  # file and line, for messages
    cells: dict[str, str]  # column -> text without blanks at its ends
    decimal: str  # "," if semicolons or tabs separate the cells, otherwise "."

    def text(self, column: str) -> str:
        """Return a cell's text; raise a BadInputError if the row ends before the column."""
        if column not in self.cells:
            raise BadInputError(f"{self.where}: {column} is nothing; give a number")
        return self.cells[column]

    def number(
        self, column: str, low: float = -inf, high: float = inf, wanted: str = "a finite number"
    ) -> float:
        """Parse a cell as a number from `low` to `high` [any unit].

        If the cell contains no such number, raise a BadInputError whose message asks for `wanted`.
        """
        text = self.text(column)
        try:
            return Quantity(ge=low, le=high).read(text.replace(self.decimal, "."))  # type: ignore[no-any-return]
        except InvalidValueError:
            shown = repr(text[:40]) if text else "nothing"
            raise BadInputError(f"{self.where}: {column} is {shown}; give {wanted}") from None


def read_rows(
    lines: Iterable[str], name: str, way: str = NO_HEADER
) -> tuple[list[str], Iterator[Row]]:
    """Read a CSV file with a header; commas, semicolons or tabs separate the cells.

    Blank lines and comments are skipped. A file without a header is rejected, and so is a row with
    more cells than the header. `way` says what to do about numbers without a header.

    Returns:
        Names of the columns in lower case ("RTT (ms)" becomes rtt_ms), and the rows.
    """
    data = ((n, one) for n, one in enumerate(lines, 1) if _has_data(one))
    kept = ((n, line) for n, line in data if not line.startswith("sep="))
    _, header = next(kept, (1, ""))
    separator = _separator(header)
    columns = [_column(cell) for cell in _cells(header, separator, f"{name}, line 1")]
    if all(_parse(cell) is not None for cell in re.split(r"[,;\s]+", header.strip())):
        raise BadInputError(f"{name}: has numbers without a header; {way}")

    def rows() -> Iterator[Row]:
        for number, line in kept:
            where = f"{name}, line {number}"
            cells = _cells(line, separator, where)
            if len(cells) > len(columns):
                raise BadInputError(
                    f"{where}: more values than columns; give {len(columns)}, and numbers without "
                    "commas"
                )
            named = dict(zip(columns, map(str.strip, cells), strict=False))
            yield Row(where, named, "." if separator == "," else ",")

    return columns, rows()


def _has_data(line: str) -> bool:
    return bool(line.strip()) and line[:1] != "#"


def _separator(header: str) -> str:
    return next((mark for mark in ";\t" if mark in header), ",")


def _cells(line: str, separator: str, where: str) -> list[str]:
    if '"' not in line:
        return line.split(separator)
    try:
        return next(csv.reader([line], delimiter=separator, skipinitialspace=True), [])
    except csv.Error as error:
        raise BadInputError(f"{where}: {error}; give a CSV file") from None


def _parse(text: str) -> float | None:
    try:
        return ANY.read(text)  # type: ignore[no-any-return]
    except InvalidValueError:
        return None


def _column(text: str) -> str:
    words = re.sub(r"[^\w]+", "_", text.strip().lower()).strip("_")
    return words.replace("µ", "u").replace("μ", "u")


def _number(row: Row, column: str) -> float:
    """Parse a number of a trace; reject negative and infinite numbers, and a loss above 1."""
    if column == "loss":
        return row.number(column, 0.0, 1.0, "a number from 0 to 1")
    mark = "; a lost packet has loss 1" if column in _SCALES else ""
    return row.number(column, 0.0, inf, f"a number that is finite and not negative{mark}")
