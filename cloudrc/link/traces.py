"""Read and write traces: CSV files of delay and loss over time, which link profiles use.

A trace has the header `time_s,delay_ms` or `time_s,delay_ms,loss`, and one row per instant in
rising order of time; `delay_us` may replace `delay_ms`. Delays are one way.
`link/trace_logs.py` converts the logs of other tools to traces.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import fields
from functools import lru_cache
from math import fsum, sqrt
from pathlib import Path
from typing import Any, NamedTuple

from cloudrc.errors import BadInputError
from cloudrc.files import version
from cloudrc.link.profile import (
    Blackout,
    Change,
    DirectionKeys,
    DirectionProfile,
    GilbertElliott,
    Trace,
)
from cloudrc.outside.paths import read_file
from cloudrc.outside.refusal import naming
from cloudrc.outside.values import ANY, Quantity
from cloudrc.rounding import differences

SIZE_MAX = 64 << 20  # size limit of a file [bytes]: half a day at 100 packets a second
START_MAX = 600.0  # if the first row is later, times count from the first row [s]
_COLUMNS = dict.fromkeys(("time_s", "delay_ms", "delay_us"), Quantity(ge=0))
_COLUMNS["loss"] = Quantity(ge=0, le=1)


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
    return parse_trace(read_lines(path, f"trace {path}", remedy, size_max), str(path))


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
    """Read the lines of a text file; if that fails, raise a BadInputError with a remedy."""
    return read_file(path, name, remedy, size_max).decode("utf-8-sig", "replace").splitlines()


def read_table(path: Path, size_max: int = SIZE_MAX) -> tuple[float, ...]:
    """Read the distribution of a trace's delays, without lost packets.

    Return the delays, shifted and scaled to mean 0 and standard deviation 1, rising, shape (n,).
    Raise a BadInputError if the file is no trace, or has fewer than two different delays.
    """
    trace = read_trace(path, size_max)
    losses = trace.losses or (0.0,) * len(trace.delays)
    delays = [delay for delay, loss in zip(trace.delays, losses, strict=True) if loss < 1.0]
    if not delays or not differences(min(delays), max(delays)):
        raise BadInputError(f"table {path}: needs at least two different delays")
    mean = fsum(delays) / len(delays)
    deviation = sqrt(fsum((delay - mean) ** 2 for delay in delays) / len(delays))
    return tuple(sorted((delay - mean) / deviation for delay in delays))


def parse_trace(lines: Iterable[str], name: str) -> Trace:
    """Parse the lines of the trace file `name`; raise a BadInputError if they are no trace.

    If the first row's time is above `START_MAX` [s], subtract this time from all times.
    """
    place = f"trace {name}"
    columns, rows = read_rows(lines, place)
    delay = "delay_us" if "delay_us" in columns else "delay_ms"
    wanted = ["time_s", delay, "loss"][: len(columns)]
    if sorted(columns) != sorted(wanted) or len(wanted) < 2:
        shown = ",".join(columns)[:200] or "missing"
        raise BadInputError(
            f"{place}: the header is {shown}; it must be time_s,delay_ms or time_s,delay_us, and "
            "may end in ,loss"
        )
    found = list[list[float]]()
    for row in rows:
        found.append([row.number(column, _COLUMNS[column]) for column in wanted])
        if len(found) > 1 and found[-1][0] <= found[-2][0]:
            raise BadInputError(
                f"{row.where}: time_s {found[-1][0]:.12g} does not come after "
                f"{found[-2][0]:.12g}; sort the rows by time and give each time once"
            )
    if not found:
        raise BadInputError(f"{place}: no rows; give at least one, for example: 0,45")
    times, delays, *losses = zip(*found, strict=True)
    start = times[0] if times[0] > START_MAX else 0.0
    scale = 1e-6 if delay == "delay_us" else 1e-3
    scaled = tuple(one * scale for one in delays)
    return Trace(tuple(time - start for time in times), scaled, losses[0] if losses else None)


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
    cells: dict[str, str]  # column -> text without blanks and quotes at its ends

    def number(self, column: str, valid: Quantity = ANY) -> float:
        """Parse a cell as a number, or raise a BadInputError that says what is valid."""
        with naming(f"{self.where}: {column}"):
            return float(valid.read(self.cells[column]))


def read_rows(lines: Iterable[str], name: str) -> tuple[list[str], Iterator[Row]]:
    """Read a CSV file: a header, and rows whose cells commas separate.

    Blank lines and comments are skipped. A row with more or fewer cells than the header is refused.

    Returns:
        Names of the columns in lower case, and the rows.
    """
    kept = ((n, one) for n, one in enumerate(lines, 1) if one.strip() and one[0] != "#")
    _, header = next(kept, (1, ""))
    columns = [cell.lower() for cell in _cells(header)]

    def rows() -> Iterator[Row]:
        for number, line in kept:
            where, cells = f"{name}, line {number}", _cells(line)
            if len(cells) != len(columns):
                raise BadInputError(
                    f"{where}: {len(cells)} values for {len(columns)} columns; write numbers "
                    "without commas"
                )
            yield Row(where, dict(zip(columns, cells, strict=True)))

    return columns, rows()


def _cells(line: str) -> list[str]:
    return [cell.strip(' \t"') for cell in line.split(",")]
