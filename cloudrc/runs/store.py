"""Keep a sweep in a folder: one line of JSON (a row) per flight, and tables of all flights.

docs/sweeps.md describes the files. A row has no wall-clock times, so equal flights give equal rows.
"""

from __future__ import annotations

import csv
import io
import json
import logging
from codecs import BOM_UTF8, BOM_UTF16_BE, BOM_UTF16_LE
from collections import Counter
from collections.abc import Callable, Collection, Hashable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from importlib import import_module
from importlib.util import find_spec
from io import SEEK_END, BufferedReader
from pathlib import Path
from typing import Any

from pydantic import BaseModel, ConfigDict, FiniteFloat, ValidationError

from cloudrc import files
from cloudrc.errors import BadInputError, to_one_line
from cloudrc.files import open_file, write_atomically
from cloudrc.outside.document import read_document, write_yaml
from cloudrc.runs.flight import Row
from cloudrc.runs.grid import Grid, read_grid
from cloudrc.runs.lock import LOCK
from cloudrc.source import code_hash
from cloudrc.version import __version__

FILE, SUMMARY = "sweep.yaml", "sweep.json"
TABLE, PARQUET = "table.csv", "table.parquet"
NUMBERS = {int, float, type(None)}
"""Types of the values of an axis of numbers; None is the value null."""
LINE_MAX = 1 << 20
"""Largest length of a row [bytes]."""
SUMMARY_MAX = 1 << 26
"""Largest length of the file SUMMARY [bytes]."""
NAMED_MAX = 3
"""Largest number of changed files that an error names."""


class _Document(BaseModel):
    """A document that is read; it may have more fields."""

    model_config = ConfigDict(extra="allow", strict=True)


class _RowDocument(_Document):
    """The form of a row."""

    key: str
    point: dict[str, Any]
    seed: int
    verdict: str
    failures: list[str]
    text: str
    numbers: dict[str, int | FiniteFloat]
    records_sha256: str | None


def read_rows(folder: Path) -> dict[str, Row]:
    """Read the rows of all files: a flight's key -> row; ignore an unfinished last line.

    Raises:
        BadInputError: If a file cannot be read, or if a line is not a row.
    """
    found: dict[str, Row] = {}
    for path in sorted(folder.glob("rows*.jsonl")):
        for number, line in enumerate(_lines(path), start=1):
            row = parse_row(line)
            if row is None:
                text = "is not a row of a sweep; delete this line to fly its flight again"
                raise BadInputError(f"{path}:{number}: {text}")
            found.setdefault(row["key"], row)
    return found


def _lines(path: Path) -> Iterator[bytes]:
    """Yield the lines of a file that end; raise a BadInputError for what is no file of rows.

    An editor may have saved the file with a byte order mark.
    """
    try:
        with BufferedReader(open_file(path)) as file:
            if file.peek(2).startswith((BOM_UTF16_LE, BOM_UTF16_BE)):
                raise BadInputError(f"{path}: is saved as UTF-16; save it as UTF-8")
            while (line := file.readline(LINE_MAX)).endswith(b"\n"):
                yield line.removeprefix(BOM_UTF8)
    except (OSError, ValueError) as error:
        reason = getattr(error, "strerror", None) or "it is not a file"
        raise BadInputError(f"{path}: cannot be read: {reason}; move it away") from error
    if len(line) == LINE_MAX:
        raise BadInputError(f"{path}: has a line above {LINE_MAX} bytes, so it has no rows")


def parse_row(line: bytes | str) -> Row | None:
    """Parse a line of JSON as a row; return None if it is not a row."""
    with suppress(ValidationError):
        return dict(_RowDocument.model_validate_json(line))
    return None


@contextmanager
def append_rows(folder: Path, shard: int | None) -> Iterator[Callable[[Row], None]]:
    """Yield a function that appends a row to the file of shard number `shard`.

    If `shard` is None, the sweep is not divided, and the function appends to its only file.
    """
    path = folder / ("rows.jsonl" if shard is None else f"rows-{shard}.jsonl")
    with path.open("ab+", buffering=0) as file:
        start = max(0, file.seek(0, SEEK_END) - LINE_MAX)
        file.seek(start)
        file.truncate(start + file.read().rfind(b"\n") + 1)  # a kill may leave half a line

        def append(row: Row) -> None:
            rest = memoryview(json.dumps(row, allow_nan=False).encode() + b"\n")
            try:
                while rest:  # a disk that becomes full takes a part
                    rest = rest[file.write(rest) :]
            except OSError as error:
                error.filename = str(path)
                raise

        yield append


def is_begun(folder: Path) -> bool:
    """Return whether a folder is that of a sweep: it has a summary, which only cloudrc writes.

    Before a command writes the summary, it has locked the folder and written the file of the sweep.
    So a folder with a lock and at most this file also counts.
    """
    with suppress(BadInputError):
        return bool(read_summary(folder))
    names = [path.name for path in folder.iterdir()] if folder.is_dir() else []
    begun = all(name.startswith((LOCK, FILE, f".{FILE}.", f".{SUMMARY}.")) for name in names)
    return begun and any(name.startswith(LOCK) for name in names)


def begin(folder: Path, grid: Grid, *, is_shared: bool = False) -> dict[str, Row]:
    """Write the file of a sweep into `folder`; return flight key -> row of earlier flights.

    `is_shared` tells whether shards on other machines may fly into the same folder.

    Raises:
        BadInputError: If the folder belongs to another sweep or to other code.
    """
    rows = read_rows(folder)
    refuse_other_code(folder, rows.values(), is_shared)
    is_same = _has_same_file(folder, grid, is_shared)
    if any(grid.point_of.get(key) != row["point"] for key, row in rows.items()):
        text = f"has flights that are not in {FILE}, or a file that it names has changed since"
        text = describe_changes(folder, grid.files) or text
        raise BadInputError(f"--out {folder}: {text}; name a new folder")
    if not is_same:
        write_atomically(folder / FILE, write_yaml(grid.file).encode())
    _write_summary(folder, grid, rows)
    if len(rows) < len(grid.point_of):  # tables of a smaller grid would look complete
        for name in (TABLE, PARQUET):
            (folder / name).unlink(missing_ok=True)
    return rows


def describe_changes(folder: Path, files: Mapping[str, str]) -> str:
    """Say which of the user's files (path -> hash) have changed since they were flown; "" if none.

    A folder of an earlier version does not have the hashes.
    """
    before: dict[str, str] = {}
    with suppress(BadInputError):  # no summary
        before = read_summary(folder)["files"]
    changed = [path for path, each in files.items() if before.get(path, each) != each]
    changed[NAMED_MAX:] = [f"{len(changed) - NAMED_MAX} more"] if changed[NAMED_MAX:] else []
    return f"changed since its flights: {', '.join(changed)}" if changed else ""


def refuse_other_code(folder: Path, rows: Iterable[Row], is_shared: bool) -> None:
    """Raise a BadInputError if flights of other code are in `folder`, or fly into it now."""
    codes = {row.get("code") for row in rows}
    if is_shared and (folder / SUMMARY).exists():  # of a shard that may have no row yet
        codes.add(read_summary(folder).get("code"))
    for code in codes - {code_hash()}:
        was = f"code {code}" if code else "code without a hash, of an earlier version"
        raise BadInputError(
            f"--out {folder}: its flights are of {was}, this is code {code_hash()}; "
            "name a new folder, or go on with the code of its flights"
        )


def finish(folder: Path, grid: Grid) -> dict[str, Row]:
    """Write the summary and, if no flight is missing, the tables; return flight key -> row."""
    rows = read_rows(folder)
    _write_summary(folder, grid, rows)
    if rows.keys() == grid.point_of.keys():
        columns = columns_of([rows[key] for key in grid.point_of], grid)
        write_atomically(folder / TABLE, as_csv(columns, grid.units).encode())
        if find_spec("pyarrow"):
            parquet, tables = import_module("pyarrow.parquet"), import_module("pyarrow")
            parquet.write_table(tables.table(columns), folder / PARQUET)
    return rows


def as_csv(columns: Mapping[str, Sequence[Any]], unit_of: Mapping[str, str]) -> str:
    """Format columns of equal length as CSV; the first line has names, and units in brackets."""
    head = [f"{name} [{unit_of[name]}]" if name in unit_of else name for name in columns]
    text = io.StringIO()
    cells = [head, *zip(*columns.values(), strict=True)]
    csv.writer(text, lineterminator="\n").writerows(cells)
    return text.getvalue()


def columns_of(rows: list[Row], grid: Grid) -> dict[str, list[Any]]:
    """Return the columns of a sweep's tables; an axis of numbers and other values becomes text."""

    def column(name: str) -> list[Any]:
        return [row.get(name, "") for row in rows]

    axes = {axis: _axis_column([row["point"][axis] for row in rows]) for axis in grid.axes}
    names = sorted({name for row in rows for name in row["numbers"]})
    return {
        "key": column("key"),
        **axes,
        "seed": column("seed"),
        "verdict": column("verdict"),
        "failures": [" ".join(row["failures"]) for row in rows],
        "code": column("code"),
        "physics_steps": column("physics_steps"),
        **{name: [row["numbers"].get(name) for row in rows] for name in names},
    }


def _axis_column(values: list[Any]) -> list[Any]:
    """Return the column of an axis: texts, truth values, or numbers and None; else all as text."""
    types = {*map(type, values)}
    plain = types <= NUMBERS or types in ({str}, {bool})
    return values if plain else [*map(as_text, values)]


def as_text(value: Any) -> str:
    """Format the value of an axis or a setting."""
    return value if isinstance(value, str) else json.dumps(value)


class _SummaryDocument(_Document):
    """The form of the file SUMMARY."""

    experiment: str = ""
    axes: dict[str, list[Any]]
    flights: int
    units: dict[str, str]
    files: dict[str, str] = {}


def read_summary(folder: Path) -> dict[str, Any]:
    """Read the description of a sweep; raise a BadInputError if `folder` is not that of a sweep."""
    with suppress(OSError, ValueError):
        return dict(_SummaryDocument.model_validate_json(files.read(folder / SUMMARY, SUMMARY_MAX)))
    raise BadInputError(f"{folder}: is not a folder of 'cloudrc sweep run'; name one")


def _has_same_file(folder: Path, grid: Grid, is_shared: bool) -> bool:
    """Return whether the file of a sweep in `folder` says the same; if so, it stays as it is.

    Raise a BadInputError if something would be lost with the file: what a user has written, or a
    flight that `grid` does not have.
    """
    path = folder / FILE
    old = path.read_bytes() if path.exists() else b""
    if not old:
        return False
    tree = read_document(path, str(path)).tree
    if tree in (grid.file, _without_folder(grid.file)):
        return True
    if is_shared and _without_folder(tree) == _without_folder(grid.file):
        return True  # shards of several machines may have it in different places
    if write_yaml(tree).encode() != old:
        raise BadInputError(
            f"{path}: was written or edited by hand; name a new folder with --out, or move the file"
        )
    if not read_grid(path).point_of.keys() <= grid.point_of.keys():
        raise BadInputError(f"--out {folder}: has another sweep, see {FILE}; name a new folder")
    return False


def _without_folder(file: Mapping[str, Any]) -> dict[str, Any]:
    return {key: value for key, value in file.items() if key != "folder"}


def check_points(folder: Path, rows: Collection[Row], axes: Mapping[str, Sequence[Any]]) -> None:
    """Raise a BadInputError if a row has another point than those of the sweep in `folder`.

    Warn if the rows are of more than one code, whose difference may be what the rows show.
    """
    codes = {str(row.get("code") or "without a hash") for row in rows}
    if len(codes) > 1:
        text = to_one_line(
            f"{folder}: its flights are of different code: {' and '.join(sorted(codes))}"
        )
        logging.getLogger("cloudrc").warning("%s", text)
    known = {axis: {*map(frozen, values)} for axis, values in axes.items()}
    for row in rows:
        point = row["point"]
        if point.keys() != known.keys() or any(frozen(point[a]) not in known[a] for a in known):
            text = f"the row {row['key']} has another point than those in {SUMMARY}: {point}"
            raise BadInputError(to_one_line(f"{folder}: {text}; name the folder of one sweep"))


def read_flights(folder: Path) -> tuple[list[Row], dict[str, str], str]:
    """Read the rows of a sweep in the order of its grid.

    Also return metric -> unit, and how many flights are missing, in words ("" if none). Values of
    axes that are neither numbers nor text become JSON text. Raise a BadInputError if there are no
    rows.
    """
    summary = read_summary(folder)
    axes = summary["axes"]
    places = {axis: {frozen(v): n for n, v in enumerate(axes[axis])} for axis in axes}

    def place(row: Row) -> list[int]:
        return [*(places[axis][frozen(v)] for axis, v in row["point"].items()), row["seed"]]

    found = read_rows(folder).values()
    check_points(folder, found, axes)
    rows = sorted(found, key=place)
    for row in rows:
        row["point"] = {axis: value if type(value) in (str, int, float) else json.dumps(value)
                        for axis, value in row["point"].items()}  # fmt: skip
    if not rows:
        raise BadInputError(f"{folder}: has no rows; run the sweep again with this --out")
    missing = summary["flights"] - len(rows)
    unknown = dict.fromkeys((name for row in rows for name in row["numbers"]), "")
    return (
        rows,
        {**unknown, **summary["units"]},
        f"{missing} flights are not done" if missing else "",
    )


def frozen(value: Any) -> Hashable:
    """Convert a value of an axis so that it can be looked up; equal values become equal."""
    if isinstance(value, list):
        return tuple(map(frozen, value))
    if isinstance(value, dict):
        return frozenset((key, frozen(each)) for key, each in value.items())
    plain: Hashable = value
    return plain


def values_of(rows: Sequence[Row]) -> dict[str, list[Any]]:
    """Return a mapping: axis -> its different values in `rows`, in the order of `rows`."""
    return {axis: list(dict.fromkeys(row["point"][axis] for row in rows))
            for axis in rows[0]["point"]}  # fmt: skip


def _write_summary(folder: Path, grid: Grid, rows: Mapping[str, Row]) -> None:
    """Write the file SUMMARY of a sweep."""
    summary = {
        "schemaVersion": 1,
        "experiment": grid.name,
        "cloudrc": __version__,
        "code": code_hash(),
        "overrides": [f"{key}={as_text(value)}" for key, value in grid.file.get("set", {}).items()],
        "axes": grid.axes,
        "seeds": grid.seeds,
        "flights": len(grid.point_of),
        "counts": dict(sorted(Counter(row["verdict"] for row in rows.values()).items())),
        "units": grid.units,
        "files": grid.files,
    }
    write_atomically(folder / SUMMARY, f"{json.dumps(summary, indent=2)}\n".encode())
