# SPDX-License-Identifier: Apache-2.0

"""Write rows as a flat table, a line per trial: CSV or Parquet."""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping, Sequence
from importlib import import_module
from pathlib import Path
from typing import Any

from cloudrc.base.files import write_atomically
from cloudrc.base.text import csv_table
from cloudrc.flight.trials.rows import Row

CSV, PARQUET = ".csv", ".parquet"
"""Endings of the files of tables; the second needs the package pyarrow."""
NUMBERS = {int, float, type(None)}
"""Types of the values of an axis of numbers; None is the value null."""
Columns = Mapping[str, Sequence[Any]]
"""Name -> values of equal number."""


def columns_of(rows: Sequence[Row], axes: Iterable[str], own: Iterable[str]) -> Columns:
    """Return the columns of a table: key, axes, the fields `own` of a row, and all numbers.

    An axis of numbers and other values becomes text.
    """
    names = sorted({name for row in rows for name in row["numbers"]})
    columns: dict[str, Sequence[Any]] = {"key": [row["key"] for row in rows]}
    columns |= {axis: _axis_column([row["point"][axis] for row in rows]) for axis in axes}
    columns |= {name: [_flat(row.get(name, "")) for row in rows] for name in own}
    return {**columns, **{name: [row["numbers"].get(name) for row in rows] for name in names}}


def _flat(value: Any) -> Any:
    return " ".join(value) if isinstance(value, list) else value


def _axis_column(values: list[Any]) -> list[Any]:
    """Return the column of an axis: texts, truth values, or numbers and None; else all as text."""
    types = {*map(type, values)}
    plain = types <= NUMBERS or types in ({str}, {bool})
    return values if plain else [*map(as_text, values)]


def as_text(value: Any) -> str:
    """Format the value of an axis or a setting."""
    return value if isinstance(value, str) else json.dumps(value)


def as_csv(columns: Columns, unit_of: Mapping[str, str]) -> str:
    """Format columns as CSV; the first line has names, and units in brackets."""
    head = [f"{name} [{unit_of[name]}]" if name in unit_of else name for name in columns]
    rows = zip(*columns.values(), strict=True)
    return csv_table([dict(zip(head, row, strict=True)) for row in rows]) + "\n"


def write_table(path: Path, columns: Columns, unit_of: Mapping[str, str]) -> None:
    """Write columns in the form that the ending of `path` names; only CSV has the units."""
    if path.suffix == PARQUET:
        parquet, tables = import_module("pyarrow.parquet"), import_module("pyarrow")
        parquet.write_table(tables.table(columns), path)
    else:
        write_atomically(path, as_csv(columns, unit_of).encode())
