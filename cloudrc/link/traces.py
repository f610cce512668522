# SPDX-License-Identifier: Apache-2.0

"""Read and write traces: CSV files of delay and loss over time, which link profiles use.

A trace has the columns `time_s` and `delay_ms`, also in other units, and may have `loss`. Each row
is an instant, in rising order of time. Delays are one way. A trace of rates is a file of mahimahi.
`link/trace_logs.py` converts the logs of other tools to traces.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import fields
from functools import lru_cache
from math import fsum, sqrt
from pathlib import Path
from typing import Any

from cloudrc.base.errors import BadInputError
from cloudrc.base.files import version
from cloudrc.base.outside.paths import read_file
from cloudrc.base.outside.refusal import naming
from cloudrc.base.outside.tables import SECONDS, SHARE, SIZE_MAX, CsvTable, read_lines
from cloudrc.base.outside.values import InvalidValueError, Quantity
from cloudrc.base.rounding import differences
from cloudrc.link.profile import (
    Blackout,
    Change,
    DirectionKeys,
    DirectionProfile,
    GilbertElliott,
    Radio,
    Trace,
    refuse_period,
)

START_MAX = 600.0  # if the first row is later, times count from the first row [s]
EXAMPLE = "time_s,delay_ms,loss"
RATE_SUFFIXES = {".up": "uplink", ".down": "downlink"}
"""End of the name of a file that mahimahi has recorded -> its direction."""
_RATES_MAX = 64 << 20  # size limit of a trace of rates [bytes]
_TIME = Quantity("ms", ge=0, le=1e9, whole=True)


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
    remedy = f"give a CSV file with the columns {EXAMPLE}"
    return parse_trace(read_lines(path, f"trace {path}", remedy, size_max), str(path))


def link_profile(direction: DirectionKeys, file_max: int = SIZE_MAX) -> DirectionProfile:
    """Read the files that one direction of a link profile names.

    Raise a BadInputError if a file cannot be used or is longer than `file_max` bytes.
    """
    table = direction.distribution == "table" and direction.table
    rows = read_trace(Path(direction.trace), file_max) if direction.trace else None
    if rows and (text := refuse_period(direction.repeat_s, rows.times[-1])):
        raise BadInputError(f"trace {direction.trace}: {text}")
    rates = direction.rate_trace
    return DirectionProfile(
        **{key.name: _plain(getattr(direction, key.name)) for key in fields(DirectionKeys)},
        rows=rows,
        quantiles=read_table(Path(table), file_max) if table else (),
        opportunities=read_opportunities(Path(rates), file_max) if rates else (),
    )


def _plain(value: Any) -> Any:
    """Return a value of a profile with the plain classes in place of those of the schema."""
    if isinstance(value, tuple):
        return tuple(_plain(one) for one in value)
    for kind in (GilbertElliott, Blackout, Change, Radio):
        if isinstance(value, kind):
            return kind(**{key.name: _plain(getattr(value, key.name)) for key in fields(kind)})
    return value


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


def read_opportunities(path: Path, size_max: int = _RATES_MAX) -> tuple[int, ...]:
    """Read the times of the opportunities [ns]; an unchanged file is read once.

    Raises:
        BadInputError: If the file cannot be read, or if its times do not rise.
    """
    return _read_opportunities(path, size_max, version(path))


@lru_cache(maxsize=4)
def _read_opportunities(path: Path, size_max: int, state: object) -> tuple[int, ...]:
    """Read a file; `state` changes with it."""
    name, times = f"rate_trace {path}", list[int]()
    data = read_file(path, name, "give a file of mahimahi: a line per packet, in ms", size_max)
    for number, line in enumerate(data.decode("utf-8", "replace").splitlines(), 1):
        with naming(f"{name}, line {number}"):
            time = _TIME.read(line)
            if times and time < times[-1]:
                raise InvalidValueError(f"{time} ms comes before {times[-1]} ms")
        times.append(time)
    if not times or not times[-1]:
        raise BadInputError(f"{name}: its last line is its period in ms, and must be above 0")
    return tuple(time * 1_000_000 for time in times)


def parse_trace(lines: Iterable[str], name: str) -> Trace:
    """Parse the lines of the trace file `name`; raise a BadInputError if they are no trace.

    If the first row's time is above `START_MAX` [s], subtract this time from all times.
    """
    table = CsvTable(lines, f"trace {name}", EXAMPLE)
    columns = [table.column((each,), SECONDS, Quantity(ge=0)) for each in ("time", "delay")]
    if loss := table.find(("loss",), SHARE, Quantity(ge=0, le=1)):
        columns.append(loss)
    table.refuse_others(*columns)
    found = list[list[float]]()
    for row in table.rows:
        found.append([row.number(column) * column.scale for column in columns])
        if len(found) > 1 and found[-1][0] <= found[-2][0]:
            raise BadInputError(
                f"{row.where}: time {found[-1][0]:.12g} s does not come after "
                f"{found[-2][0]:.12g} s; sort the rows by time and give each time once"
            )
    if not found:
        raise BadInputError(f"{table.place}: no rows; give at least one, for example: 0,45")
    times, delays, *losses = zip(*found, strict=True)
    start = times[0] if times[0] > START_MAX else 0.0
    return Trace(tuple(time - start for time in times), delays, losses[0] if losses else None)


def write_trace(trace: Trace) -> str:
    """Format a trace as a CSV text that `read_trace` can read."""
    lines = ["time_s,delay_ms" + ",loss" * (trace.losses is not None)]
    for row, (time, delay) in enumerate(zip(trace.times, trace.delays, strict=True)):
        loss = "" if trace.losses is None else f",{trace.losses[row]:g}"
        lines.append(f"{_short(time, 9)},{_short(delay * 1e3, 6)}{loss}")
    return "\n".join(lines) + "\n"


def _short(value: float, digits: int) -> str:
    return f"{value:.{digits}f}".rstrip("0").rstrip(".")
