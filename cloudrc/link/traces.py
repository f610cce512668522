"""Read and write traces: delay and loss over time as CSV, for `trace` and `table` of a profile.

A trace has the header `time_s,delay_ms` or `time_s,delay_ms,loss` and one row per instant, in
rising order of time; `delay_us` may replace `delay_ms`. Delays are one way. `link/logs.py` turns
the logs of other tools into traces.
"""

from __future__ import annotations

import csv
import re
from collections.abc import Iterable, Iterator
from itertools import pairwise
from math import fsum, inf, sqrt
from pathlib import Path
from typing import NamedTuple

from cloudrc.errors import BadInputError
from cloudrc.files import read
from cloudrc.link.profile import Trace

SIZE_MAX = 64 << 20
"""Size limit of a file [bytes]: half a day at 100 packets a second."""
START_MAX = 600.0
"""Latest time of a trace's first row [s]; until then a flight would see only this row."""
UNIX_TIME = 1e8
"""If the first row has this time or a later one, times are Unix times [s] (1e8 is March 1973), and
the first time is subtracted."""
_TIME, _LOSS = "time_s", "loss"
_SCALES = {"delay_ms": 1e-3, "delay_us": 1e-6}
_HEADER = "the header is time_s,delay_ms[,loss]"
_ROWS_TO_JUDGE = 10
"""A delay of 0 may mark a lost packet only in traces with at least this number of rows [1]; shorter
traces are typed by hand."""


def read_trace(path: Path, size_max: int = SIZE_MAX) -> Trace:
    """Read a trace from a CSV file.

    Args:
        path: The file.
        size_max: Size limit of the file [bytes].

    Returns:
        Times [s], delays [s] and, if the file has the column, losses in [0, 1].

    Raises:
        BadInputError: If the file cannot be read or is not a trace; the text names file, line,
            value and remedy.
    """
    remedy = "give a CSV file with the columns time_s,delay_ms"
    return parse_trace(read_lines(path, f"trace {path}", remedy, size_max), str(path))


def read_lines(path: Path, name: str, remedy: str, size_max: int = SIZE_MAX) -> list[str]:
    """Read the lines of a text file; if that fails, raise a BadInputError with `remedy`."""
    try:
        return decode(read(path, size_max))
    except (OSError, ValueError) as error:
        reason = getattr(error, "strerror", None) or str(error).removeprefix(f"{path}: ")
    raise BadInputError(f"{name}: {reason}; {remedy}")


def decode(data: bytes) -> list[str]:
    """Decode the lines of a text; raise a ValueError if the data are not text.

    Accepted encodings: UTF-8, UTF-16 with byte order mark (redirected output on Windows), and
    encodings with one byte per character.
    """
    if data[:2] in (b"\xff\xfe", b"\xfe\xff"):
        return data.decode("utf-16", "replace").splitlines()
    if b"\0" in data:
        raise ValueError("it is not a text file")
    try:
        return data.decode("utf-8-sig").splitlines()
    except UnicodeDecodeError:
        return data.decode("latin-1").splitlines()


def read_table(path: Path, size_max: int = SIZE_MAX) -> tuple[float, ...]:
    """Read the distribution of a trace's delays; ignore lost packets.

    Args:
        path: The file.
        size_max: Size limit of the file [bytes].

    Returns:
        The delays, shifted and scaled to mean 0 and standard deviation 1, rising, shape (n,) [1].

    Raises:
        BadInputError: In the cases of `read_trace`, and if all delays are equal.
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

    If the times are Unix times, time 0 is the first row.

    Args:
        lines: Header and rows; blank lines and lines that begin with # are skipped.
        name: Name of the file, for messages.

    Returns:
        The same as `read_trace`.

    Raises:
        BadInputError: In the cases of `read_trace`.
    """
    table = Table(lines, f"trace {name}")
    delay_column = _check_columns(table.columns, name)
    times: list[float] = []
    delays: list[float] = []
    losses: list[float] = []
    for row in table.rows():
        if row.problem:
            raise BadInputError(f"{row.where}: {row.problem}")
        times.append(_number(table, row, _TIME))
        delays.append(_number(table, row, delay_column))
        if _LOSS in row.cells:
            losses.append(_number(table, row, _LOSS, maximum=1.0))
        if len(times) > 1 and times[-1] <= times[-2]:
            raise BadInputError(
                f"{row.where}: time_s {times[-1]:.12g} does not come after {times[-2]:.12g}; "
                "sort the rows by time and give each time once"
            )
    if not times:
        raise BadInputError(f"trace {name}: no rows; give at least one, for example: 0,45")
    if delay_column == "delay_ms":
        _refuse_seconds(max(delays), name)
    if not losses:
        _refuse_marks(delays, delay_column, name)
    scaled = tuple(delay * _SCALES[delay_column] for delay in delays)
    return Trace(_from_start(times, name), scaled, tuple(losses) or None)


def write_trace(trace: Trace) -> str:
    """Format a trace as the CSV that `read_trace` reads.

    If all delays are below 1 ms, the column is `delay_us`: the reader would take milliseconds below
    1 for seconds and reject them.
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


class Row(NamedTuple):
    """One row of a CSV file.

    Attributes:
        where: File and line of the row, for messages.
        cells: Column -> text, stripped.
        problem: Why the row cannot be used; "" without a problem.
    """

    where: str
    cells: dict[str, str]
    problem: str = ""


class Table:
    """A CSV file with a header, separated by commas, semicolons or tabs.

    Attributes:
        columns: Names of the columns in lower case; "RTT (ms)" becomes rtt_ms.
    """

    def __init__(self, lines: Iterable[str], name: str) -> None:
        """Read the header; raise a BadInputError if the file has only numbers.

        Args:
            lines: Lines of the file; blank lines and comments are skipped.
            name: Name of the file, for messages.
        """
        kept = ((n, line) for n, line in enumerate(lines, 1) if _is_data(line))
        self.name = name
        self._first = next(kept, (1, ""))
        self._lines = kept
        header = self._first[1]
        self._separator = next((mark for mark in ";\t" if mark in header), ",")
        self.columns = [_column(cell) for cell in self._cells(header, 1)]
        if len(self.columns) == 1 and _is_number(header):
            self._refuse_bare_numbers()

    def rows(self) -> Iterator[Row]:
        """Yield the rows; a row with fewer cells than the header gets a `problem`.

        Raises:
            BadInputError: If a row has more cells than the header: decimal commas may have split
                its numbers.
        """
        columns = self.columns
        for number, line in self._lines:
            where = f"{self.name}, line {number}"
            cells = self._cells(line, number)
            if len(cells) > len(columns):
                raise BadInputError(
                    f"{where}: more values than columns; give {len(columns)}, and numbers without "
                    "commas"
                )
            if len(cells) < len(columns):
                yield Row(where, {}, f"{columns[len(cells)]} is nothing; give a number")
                continue
            yield Row(where, dict(zip(columns, map(str.strip, cells), strict=True)))

    def number(self, text: str) -> float | None:
        """Parse a number; None if the text is not a number.

        If semicolons or tabs separate the cells, a comma is a decimal point.
        """
        if self._separator != ",":
            text = text.replace(",", ".")
        try:
            return float(text)
        except ValueError:
            return None

    def _cells(self, line: str, number: int) -> list[str]:
        if '"' not in line:
            return line.split(self._separator)
        reader = csv.reader([line], delimiter=self._separator, skipinitialspace=True)
        try:
            return next(reader, [])
        except csv.Error as error:
            where = f"{self.name}, line {number}"
            raise BadInputError(f"{where}: {error}; give a CSV file") from None

    def _refuse_bare_numbers(self) -> None:
        """Refuse one number per line: a rate trace of mahimahi, or delays without times."""
        texts = [self._first[1], *(line for _, line in self._lines)]
        values = [float(text) for text in texts if _is_number(text)]
        rising = all(before <= after for before, after in pairwise(values))
        if len(values) > 1 and rising and all(value.is_integer() for value in values):
            rate = len(values) * 1500 * 8 / max(values[-1], 1.0)
            raise BadInputError(
                f"{self.name}: looks like a rate trace of mahimahi, times at which a packet may "
                f"leave [ms]: it has no delays; its mean is rate_kbit: {rate:.4g}"
            )
        raise BadInputError(
            f"{self.name}: has numbers without a header; of delays [ms], one every 0.1 s, make a "
            'trace: awk \'BEGIN {print "time_s,delay_ms"} {print (NR-1)*0.1 "," $1}\' FILE'
        )


def looks_lost(values: Iterable[float], decimals: int) -> bool:
    """Return whether zeros among delays mark lost packets: all other delays are far from 0.

    Args:
        values: Delays in the file's unit.
        decimals: Largest number of decimals in the file, because a zero may be a rounded delay.
    """
    values = list(values)
    shortest = min((value for value in values if value > 0.0), default=0.0)
    return 0.0 in values and shortest > 2 * 10.0**-decimals


def decimals_of(text: str) -> int:
    """Count the decimals of a number's text."""
    return len(re.sub(r"[eE].*", "", text).replace(",", ".").partition(".")[2])


def _is_data(line: str) -> bool:
    return bool(line.strip()) and not line.startswith(("#", "sep="))


def _is_number(text: str) -> bool:
    try:
        float(text)
    except ValueError:
        return False
    return True


def _column(text: str) -> str:
    words = re.sub(r"[^\w]+", "_", text.strip().lower()).strip("_")
    return words.replace("µ", "u").replace("μ", "u")


def _number(table: Table, row: Row, column: str, maximum: float = inf) -> float:
    """Parse a value of a trace that is finite, at least 0 and at most `maximum`."""
    text = row.cells[column]
    value = table.number(text)
    if value is None:
        raise BadInputError(f"{row.where}: {column} is {shown(text)}; give a number")
    if not 0.0 <= value < inf or value > maximum:
        bounds = "from 0 to 1" if maximum == 1.0 else "that is finite and not negative"
        mark = "; a lost packet has loss 1" if column in _SCALES else ""
        raise BadInputError(f"{row.where}: {column} is {text[:40]}; give a number {bounds}{mark}")
    return value


def shown(text: str) -> str:
    """Quote the text of a cell for a message: at most 40 characters; "nothing" if it is empty."""
    return repr(text[:40]) if text else "nothing"


def _from_start(times: list[float], name: str) -> tuple[float, ...]:
    """Shift Unix times so that the first row is at 0; refuse other times that begin too late."""
    start = times[0]
    if start > START_MAX * 1e9:
        raise BadInputError(f"trace {name}: time_s begins at {start:.15g}, which is not in seconds")
    if start >= UNIX_TIME:
        return tuple(time - start for time in times)
    if start > START_MAX:
        raise BadInputError(
            f"trace {name}: time_s begins at {start:.15g} s, and until then its first row would "
            f"hold; to begin at 0: cloudrc link record {name} -o NEW.csv"
        )
    return tuple(times)


def _refuse_seconds(longest_ms: float, name: str) -> None:
    """Reject delays that seem to be in seconds, a common mistake: the link would seem ideal."""
    if 0.0 < longest_ms < 1.0:
        raise BadInputError(
            f"trace {name}: delay_ms is at most {longest_ms:g}, which looks like seconds; "
            f"multiply by 1000, or name the column delay_us and give {longest_ms * 1e3:g}"
        )


def _refuse_marks(delays: list[float], column: str, name: str) -> None:
    """Reject delays of 0 that seem to mark lost packets; otherwise these would be the fastest."""
    decimals = max(decimals_of(f"{delay:g}") for delay in delays)
    if len(delays) >= _ROWS_TO_JUDGE and looks_lost(delays, decimals):
        raise BadInputError(
            f"trace {name}: {column} is 0 in {delays.count(0.0)} of {len(delays)} rows, which "
            "looks like lost packets; add the column loss: 1 where a packet was lost, else 0"
        )


def _check_columns(columns: list[str], name: str) -> str:
    """Check a header; reject missing, unknown or repeated columns; return the delay column."""
    found = ",".join(columns)[:200] or "nothing"
    for wanted in ((_TIME,), tuple(_SCALES)):
        if not any(column in columns for column in wanted):
            missing = f"trace {name}, line 1: no column {wanted[0]}, found {found}"
            raise BadInputError(f"{missing}; {_HEADER}")
    for column in columns:
        if column not in (_TIME, *_SCALES, _LOSS) or columns.count(column) > 1:
            raise BadInputError(
                f"trace {name}, line 1: column {column!r} is unknown or repeated; {_HEADER}"
            )
    given = [column for column in _SCALES if column in columns]
    if len(given) > 1:
        raise BadInputError(f"trace {name}, line 1: {' and '.join(given)}; give one of them")
    return given[0]
