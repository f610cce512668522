# SPDX-License-Identifier: Apache-2.0

"""Read tables: CSV files whose first line names the columns with their units, such as `delay_ms`.

Commas, semicolons or tabs separate the cells; numbers have a decimal point. Empty lines and lines
that begin with # do not count. All errors name the file, the line or column, and what is valid.
"""

from __future__ import annotations

import csv
import re
from collections.abc import Collection, Iterable, Iterator, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

from cloudrc.base.errors import BadInputError
from cloudrc.base.outside.paths import read_file
from cloudrc.base.outside.values import ANY, InvalidValueError, Quantity
from cloudrc.base.text import list_some, suggest_name

SIZE_MAX = 64 << 20  # size limit of a file [bytes]: half a day at 100 packets a second
SECONDS = {"s": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9}
"""Unit of a time -> its size [s]."""
MILLISECONDS = {"s": 1e3, "ms": 1.0, "us": 1e-3, "ns": 1e-6}
"""Unit of a time -> its size [ms]."""
METRES = {"m": 1.0}
"""Unit of a length -> its size [m]."""
SHARE = {"": 1.0, "%": 0.01, "pct": 0.01, "percent": 0.01}
"""Unit of a share -> its size [1]. A column of shares may have no unit."""
_NUMBERS = re.compile(r"([-+.,\d\s]|(?<=\d)e|nan)*", re.IGNORECASE)
"""A cell of numbers; the columns of a file from elsewhere may be separated by blanks."""
_DECIMAL_COMMA = re.compile(r"[-+]?\d*,\d+")


def read_lines(path: Path, named: str, remedy: str, size_max: int = SIZE_MAX) -> list[str]:
    """Read the lines of a text file; if that fails, raise a BadInputError with a remedy."""
    data = read_file(path, named, remedy, size_max)
    is_wide = data.startswith((b"\xff\xfe", b"\xfe\xff"))  # as Windows' PowerShell writes it
    return data.decode("utf-16" if is_wide else "utf-8-sig", "replace").splitlines()


class Column(NamedTuple):
    """A column that a reader takes."""

    name: str  # as the head has it
    at: int  # index in a row
    scale: float  # size of its unit [unit that the reader wants]
    valid: Quantity  # which numbers are valid, in its unit


class Row(NamedTuple):
    """A row of a table."""

    place: str  # of the table
    line: int  # from 1
    cells: list[str]  # one per column, without blanks at the ends

    @property
    def where(self) -> str:
        """The file and line, for errors."""
        return f"{self.place}, line {self.line}"

    def number(self, column: Column) -> float:
        """Read a cell as a number, in the unit of its column."""
        try:
            return float(column.valid.read(self.cells[column.at]))
        except InvalidValueError as error:
            self.refuse_comma(column.name, self.cells[column.at])
            raise BadInputError(f"{self.where}: {column.name}: {error}") from None

    def refuse_comma(self, name: str, cell: str) -> None:
        """Raise a BadInputError if a cell, that of the column `name`, has a decimal comma."""
        if _DECIMAL_COMMA.fullmatch(cell):
            text = f"{cell!r} has a decimal comma; write a point, such as 0.5"
            raise BadInputError(f"{self.where}: {name}: {text}")


class CsvTable:
    """A table whose head has been read; `rows` reads the rows once.

    A column such as `delay_ms` has a name and a unit: methods take the names and units that fit; a
    unit has a size. `valid` says which numbers are valid, in the unit of size 1.
    """

    def __init__(self, lines: Iterable[str], place: str, example: str) -> None:
        """Read the head; `place` names the table in errors, `example` is a valid head."""
        self.place, self._example = place, example
        kept = [line if line.strip() and line[0] != "#" else "" for line in lines]
        first = next((n for n, line in enumerate(kept) if line), 0)
        head = "".join(kept[first : first + 1])
        self._separator = next((each for each in "\t;" if each in head), ",")
        self.head = [cell.strip() for cell in next(self._split([head]))]
        self._keys = [_key(cell) for cell in self.head]
        self._check_head(first + 1)
        self.rows = self._read_rows(kept[first + 1 :], first + 1)

    @classmethod
    def read(cls, path: Path, place: str, example: str, size_max: int = SIZE_MAX) -> CsvTable:
        """Open a file of at most `size_max` bytes."""
        remedy = f"give a CSV file with the columns {example}"
        return cls(read_lines(path, place, remedy, size_max), place, example)

    def find(
        self, names: Collection[str], units: Mapping[str, float], valid: Quantity = ANY
    ) -> Column | None:
        """Return the column that fits; None if there is none."""
        sizes = {f"{name}_{unit}".rstrip("_"): units[unit] for name in names for unit in units}
        found = [n for n, key in enumerate(self._keys) if key in sizes]
        if len(found) > 1:
            shown = ", ".join(self.head[n] for n in found)
            raise BadInputError(f"{self.place}: several columns of one kind: {shown}; leave one")
        if found:
            return self._column(found[0], sizes[self._keys[found[0]]], valid)
        if bare := next((key for key in self._keys if key in names), ""):
            known = " or ".join(f"{bare}_{unit}" for unit in units)
            raise BadInputError(f"{self.place}: column {bare} has no unit; name it {known}")
        return None

    def column(
        self, names: Collection[str], units: Mapping[str, float], valid: Quantity = ANY
    ) -> Column:
        """Return the column that fits; it has to be there."""
        if found := self.find(names, units, valid):
            return found
        known = [f"{name}_{unit}" for name in names for unit in units]
        odd = [key for key in self._keys if key not in self._example.split(",")]
        near = next(filter(None, (suggest_name(key, known) for key in odd)), "")
        raise BadInputError(
            f"{self.place}: no column {' or '.join(known)}; it has {list_some(self.head, 8)}; its "
            f"first line must name the columns, such as {self._example}{near}"
        )

    def only(self, name: str, units: Mapping[str, float], valid: Quantity = ANY) -> Column:
        """Return the only column that has one of the units, or of several the one of this name."""
        ends = [key.rpartition("_") for key in self._keys]
        found = [n for n, (_, _, unit) in enumerate(ends) if unit in units]
        if len(found) != 1:
            return self.column((name,), units, valid)
        return self._column(found[0], units[ends[found[0]][2]], valid)

    def containing(self, words: str, valid: Quantity = ANY) -> list[Column]:
        """Return the columns whose names contain the regular expression `words`, without a unit."""
        keys = enumerate(self._keys)
        return [self._column(n, 1.0, valid) for n, key in keys if re.search(words, key)]

    def others(self, *columns: Column | None) -> list[str]:
        """Return the names of all columns but these."""
        known = {column.at for column in columns if column}
        return [name or f"number {n + 1}" for n, name in enumerate(self.head) if n not in known]

    def refuse_others(self, *columns: Column | None) -> None:
        """Raise a BadInputError if there are other columns than these."""
        for name in self.others(*columns):
            near = suggest_name(name, self._example.split(","))
            text = f"column {name} means nothing here; leave it out; an example of the first line"
            raise BadInputError(f"{self.place}: {text}: {self._example}{near}")

    def _column(self, index: int, size: float, valid: Quantity) -> Column:
        own = valid if size == 1.0 else replace(valid, ge=valid.ge / size, le=valid.le / size)
        return Column(self.head[index], index, size, own)

    def _check_head(self, line: int) -> None:
        place = f"{self.place}, line {line}"
        remedy = f"the first line must name the columns, such as {self._example}"
        if not any(self.head):
            raise BadInputError(f"{place}: no header; {remedy}")
        if all(map(_NUMBERS.fullmatch, self.head)):
            raise BadInputError(f"{place}: numbers without a header; {remedy}")
        for n, name in enumerate(self.head):
            if name and self._keys[n] in self._keys[:n]:
                raise BadInputError(f"{place}: column {name} is there twice; leave one of them out")

    def _read_rows(self, lines: list[str], above: int) -> Iterator[Row]:
        """Read the rows; `above` is the number of lines above them."""
        reader = self._split(lines)
        try:
            for cells in filter(None, reader):
                if len(cells) != len(self.head):
                    commas = self._separator == "," and len(cells) > len(self.head)
                    text = f"{len(cells)} values for {len(self.head)} columns"
                    text += "; write numbers without commas" * commas
                    raise BadInputError(f"{self.place}, line {above + reader.line_num}: {text}")
                yield Row(self.place, above + reader.line_num, [cell.strip() for cell in cells])
        except csv.Error as error:
            raise BadInputError(f"{self.place}, line {above + reader.line_num}: {error}") from None

    def _split(self, lines: list[str]) -> Any:
        return csv.reader(lines, delimiter=self._separator, skipinitialspace=True)


def _key(name: str) -> str:
    """Return the name of a column as it is compared: `Delay [ms]` is `delay_ms`."""
    key = name.lower().replace("milliseconds", "ms").replace("seconds", "s").replace("%", " % ")
    return re.sub(r"[\s()\[\]_]+", "_", key).strip("_")
