"""Keep a sweep in a folder: one line of JSON per flight, and tables of all flights.

docs/sweeps.md describes the files. A row has no times of the machine: equal flights give equal
rows.
"""

from __future__ import annotations

import csv
import io
import json
from collections import Counter
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path
from typing import Any, TypeAlias

from cloudrc import __version__, metrics, plugins
from cloudrc.config.document import write_yaml
from cloudrc.errors import BadInputError
from cloudrc.files import write_atomically
from cloudrc.sweep.flight import ERROR, Outcome
from cloudrc.sweep.plan import Flight, Plan

Row: TypeAlias = dict[str, Any]
"""`key`, `point` (axis -> value or name), `seed`, `verdict`, `failures` (codes), `numbers`
(name -> value), `records_sha256` and, after an exception, `text`."""
FILE, SUMMARY, TABLE = "sweep.yaml", "sweep.json", "table.csv"


def make_row(flight: Flight, flown: Outcome) -> Row:
    """Make the row of a flight."""
    row = {
        "key": flight.key,
        "point": flight.point,
        "seed": flight.seed,
        "verdict": flown.verdict,
        "failures": list(flown.failures),
        "numbers": {name: number.value for name, number in flown.numbers.items()},
        "records_sha256": flown.records_sha256,
    }
    return row | ({"text": flown.text} if flown.verdict == ERROR else {})


def read_rows(folder: Path) -> dict[str, Row]:
    """Read the rows of all shards: key -> row; the unfinished last line of a file is ignored.

    Raises:
        BadInputError: If a line is not a row.
    """
    found: dict[str, Row] = {}
    for path in sorted(folder.glob("rows*.jsonl")):
        *lines, _ = path.read_bytes().split(b"\n")
        for number, line in enumerate(lines, start=1):
            try:
                row = json.loads(line)
                found.setdefault(row["key"], row)
            except (ValueError, TypeError, KeyError) as error:
                text = "is not a row of a sweep; delete this line to fly its flight again"
                raise BadInputError(f"{path}:{number}: {text}") from error
    return found


@contextmanager
def append_rows(folder: Path, shard: int | None) -> Iterator[Callable[[Row], None]]:
    """Yield a function that appends a row to the file of a shard, or to that of the whole sweep."""
    path = folder / ("rows.jsonl" if shard is None else f"rows-{shard}.jsonl")
    with path.open("ab+") as file:
        file.seek(0)
        file.truncate(file.read().rfind(b"\n") + 1)  # a killed process may leave half a line

        def append(row: Row) -> None:
            file.write(json.dumps(row, allow_nan=False).encode() + b"\n")
            file.flush()

        yield append


def begin(folder: Path, plan: Plan) -> dict[str, Row]:
    """Write the description of a sweep into its folder, and return the rows that it has.

    Raises:
        BadInputError: If the folder has rows that are not of this sweep.
    """
    rows, points = read_rows(folder), {key: each.point for key, each in plan.flights.items()}
    if any(points.get(key) != row["point"] for key, row in rows.items()):
        text = "rows of another grid, of other seeds, of changed plug-ins or another version"
        raise BadInputError(f"--out {folder}: has {text}; name a new folder")
    write_atomically(folder / FILE, write_yaml(plan.file).encode())
    _write_summary(folder, plan, rows)
    return rows


def finish(folder: Path, plan: Plan) -> dict[str, Row]:
    """Count the rows; once all flights are done, write their tables. Return the rows."""
    rows = read_rows(folder)
    units = _write_summary(folder, plan, rows)
    if len(rows) == len(plan.flights):
        columns = _columns([rows[key] for key in plan.flights], plan)
        head = [f"{name} [{units[name]}]" if name in units else name for name in columns]
        text = io.StringIO()
        cells = [head, *zip(*columns.values(), strict=True)]
        csv.writer(text, lineterminator="\n").writerows(cells)
        write_atomically(folder / TABLE, text.getvalue().encode())
        if find_spec("pyarrow"):
            parquet, tables = import_module("pyarrow.parquet"), import_module("pyarrow")
            parquet.write_table(tables.table(columns), folder / "table.parquet")
    return rows


def _columns(rows: list[Row], plan: Plan) -> dict[str, list[Any]]:
    """Return the columns of the tables; values of an axis with several types become text."""
    columns = {"key": [row["key"] for row in rows]}
    for axis in plan.axes:
        values = [row["point"][axis] for row in rows]
        plain = len({*map(type, values)}) == 1 and isinstance(values[0], str | int | float)
        columns[axis] = values if plain else [*map(as_text, values)]
    columns |= {name: [row[name] for row in rows] for name in ("seed", "verdict")}
    columns["failures"] = [" ".join(row["failures"]) for row in rows]
    names = sorted({name for row in rows for name in row["numbers"]})
    return columns | {name: [row["numbers"].get(name) for row in rows] for name in names}


def as_text(value: Any) -> str:
    """Format the value of an axis or a setting."""
    return value if isinstance(value, str) else json.dumps(value)


def read_summary(folder: Path) -> dict[str, Any]:
    """Read the description of a sweep; raise a BadInputError if `folder` is not that of a sweep."""
    try:
        summary: dict[str, Any] = json.loads((folder / SUMMARY).read_bytes())
        if {"axes", "flights"} <= summary.keys():
            return summary
    except (OSError, ValueError, AttributeError):
        pass
    raise BadInputError(f"{folder}: is not a folder of 'cloudrc sweep run'; name one")


def _write_summary(folder: Path, plan: Plan, rows: Mapping[str, Row]) -> dict[str, str]:
    """Write the description of a sweep; return the units of all metrics."""
    own = {choice for point in plan.points for choice in point.report.metrics}
    found = [metrics.find(name) for name in (*metrics.SHIPPED, *plugins.names("metrics"), *own)]
    units = {metric.name: metric.unit for metric in found}
    summary = {
        "schemaVersion": 1,
        "experiment": plan.points[0].name,
        "cloudrc": __version__,
        "overrides": [f"{key}={as_text(value)}" for key, value in plan.file.get("set", {}).items()],
        "axes": plan.axes,
        "seeds": plan.seeds,
        "flights": len(plan.flights),
        "counts": dict(sorted(Counter(row["verdict"] for row in rows.values()).items())),
        "units": units,
    }
    write_atomically(folder / SUMMARY, f"{json.dumps(summary, indent=2)}\n".encode())
    return units
