# SPDX-License-Identifier: Apache-2.0

"""Keep a sweep in a folder: rows, summary and tables of its flights.

docs/sweeps.md describes the files.
"""

from __future__ import annotations

import json
import logging
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from functools import partial
from importlib.util import find_spec
from pathlib import Path
from typing import Any, NamedTuple

from cloudrc.base import source
from cloudrc.base.errors import (
    CloudrcError,
    InvalidRunError,
    NothingFlownError,
    StateError,
    to_one_line,
)
from cloudrc.base.files import read_json, write_atomically, write_json
from cloudrc.base.outside.document import read_document, write_yaml
from cloudrc.base.outside.paths import LOCK, lock_folder
from cloudrc.base.text import table
from cloudrc.flight.fly import fly
from cloudrc.flight.folder import new_folder
from cloudrc.flight.trials import tables
from cloudrc.flight.trials.plan import COLUMNS, PlannedFlight, SweepPlan, read_plan
from cloudrc.flight.trials.rows import SIZE_MAX, Row, Rows, read_rows
from cloudrc.flight.trials.summary import added, count_successes, count_verdicts, normalise
from cloudrc.flight.trials.tables import Columns, as_text, write_table
from cloudrc.flight.trials.workers import map_in_order, take_each
from cloudrc.version import __version__

FILE, SUMMARY, PODS = "sweep.yaml", "sweep.json", "pods.json"
TABLE, PARQUET = "table.csv", "table.parquet"
Shard = tuple[int, int] | None
"""Number of a part of the flights, from 1, and how many parts there are; None: all flights."""


@contextmanager
def open_folder(out: Path | None, name: str, shard: Shard = None) -> Iterator[Path]:
    """Lock the folder of a sweep: `out`, or a new one in `runs/` whose name begins with `name`."""
    if out is not None and shard:
        out.mkdir(parents=True, exist_ok=True)  # another shard may be faster
    if out is None or not _is_ours(out):
        out = new_folder(out, name, "latest-sweep")
    with lock_folder(out, shard):
        yield out


def _is_ours(folder: Path) -> bool:
    """Return whether a folder is that of a sweep, or has nothing but what begins one."""
    names = [path.name for path in folder.iterdir()] if folder.is_dir() else ["none"]
    return SUMMARY in names or all(name.startswith((LOCK, FILE, f".{FILE}")) for name in names)


def flights_of(plan: SweepPlan, shard: Shard = None) -> list[PlannedFlight]:
    """Return the flights of a shard."""
    number, count = shard or (1, 1)
    return [*plan.flights.values()][number - 1 :: count]


def begin(folder: Path, plan: SweepPlan, shard: Shard = None) -> Rows:
    """Write the file and the summary of a sweep into `folder`, which is locked; return its rows.

    Raise a StateError if the folder has rows of another sweep or of other code.
    """
    rows = Rows(folder, shard and shard[0])
    points = {key: flight.point for key, flight in plan.flights.items()}
    if any(points.get(key) != row["point"] for key, row in rows.kept.items()):
        raise StateError(f"--out {folder}: {_why_others(folder, plan, rows)}; name a new folder")
    path = folder / FILE
    if not path.exists() or read_document(path, str(path)).tree != plan.draft.file:
        write_atomically(path, write_yaml(plan.draft.file).encode())
    _write_summary(folder, plan, rows)
    if len(rows.kept) < len(plan.flights):  # tables of a smaller grid would look complete
        for name in (TABLE, PARQUET):
            (folder / name).unlink(missing_ok=True)
    return rows


def _why_others(folder: Path, plan: SweepPlan, rows: Rows) -> str:
    """Say why a folder has rows that are not in a plan."""
    if other := {row.get("code") for row in rows.kept.values()} - {source.code_hash()}:
        return f"its flights are of code {other.pop()}, this is code {source.code_hash()}"
    before = read_summary(folder)["files"] if (folder / SUMMARY).exists() else {}
    changed = [path for path, each in plan.files.items() if before.get(path, each) != each]
    if changed:
        return f"changed since its flights: {', '.join(changed)}"
    return f"has another sweep, see {FILE}, or a package has changed since"


def finish(folder: Path, plan: SweepPlan) -> dict[str, Row]:
    """Write the summary and, if no flight is missing, the tables; return flight key -> row."""
    rows = Rows(folder)
    _write_summary(folder, plan, rows)
    if rows.kept.keys() == plan.flights.keys():
        columns = columns_of(rows.kept, plan)
        for name in (TABLE, *([PARQUET] if find_spec("pyarrow") else [])):
            write_table(folder / name, columns, plan.units)
    return rows.kept


def _write_summary(folder: Path, plan: SweepPlan, rows: Rows) -> None:
    file = plan.draft.file
    summary = {
        "schemaVersion": 1,
        "experiment": plan.name,
        "cloudrc": __version__,
        "code": source.code_hash(),
        "overrides": [f"{key}={as_text(value)}" for key, value in file.get("set", {}).items()],
        "axes": plan.axes,
        "seeds": plan.draft.seeds,
        "flights": len(plan.flights),
        "counts": dict(sorted(Counter(row["verdict"] for row in rows.kept.values()).items())),
        "units": plan.units,
        **({"baselines": plan.baselines} if plan.baselines else {}),
        "files": plan.files,
    }
    write_json(folder / SUMMARY, summary)


def read_summary(folder: Path) -> dict[str, Any]:
    """Read the description of the sweep in a folder."""
    found = read_json(folder / SUMMARY, SIZE_MAX)
    if not found.keys() >= {"axes", "flights", "units", "files"}:
        raise NothingFlownError(f"{folder}: is not a folder of 'cloudrc sweep run'; name one")
    return found


def columns_of(kept: Mapping[str, Row], plan: SweepPlan) -> Columns:
    """Return the columns of a sweep's tables, in the order of its flights."""
    known = normalise(kept, plan.baselines)
    rows = [known[key] for key in plan.flights if key in known]
    return tables.columns_of(rows, plan.axes, COLUMNS)


# Recordings of flights.


def record_missing(
    flights: Sequence[PlannedFlight], rows: Mapping[str, Row], which: str, folder: Path, jobs: int
) -> CloudrcError | None:
    """Fly the "failed" or "all" flights that have no recording again, into folders of their own.

    Return why the work ended early, or None.
    """
    wanted = [
        each
        for each in flights
        if rows[each.key]["verdict"] not in ("error", *(("success",) if which == "failed" else ()))
        and not (folder / each.key / "report.json").is_file()
    ]
    flown = map_in_order(partial(fly_into, folder, page=False), wanted, jobs)
    return take_each(flown, lambda report: None)


def fly_into(folder: Path, flight: PlannedFlight, *, page: bool) -> dict[str, Any]:
    """Fly a flight with a recording into its folder in that of the sweep; return the report."""
    out = folder / flight.key
    out.mkdir(exist_ok=True)
    (out / "environment.json").unlink(missing_ok=True)  # it describes an earlier flight
    return fly(flight.experiment, "virtual", out, page=page)


def find_row(folder: Path, begin: str) -> tuple[Row, PlannedFlight]:
    """Return the row of a sweep whose key begins like this, and the flight that repeats it.

    Raises:
        StateError: If no row, or more than one, has such a key; or if the flight would be another
            one, because code or files have changed.
    """
    rows = Rows(folder)
    found = [row for key, row in rows.kept.items() if key.startswith(begin)]
    if len(found) != 1:
        text = f"{len(found)} rows have a key that begins like this; give one key"
        raise StateError(f"{folder}: {begin}: {text}")
    (row,) = found
    plan = read_plan(folder / FILE)
    flight = plan.flights.get(row["key"])
    if flight is None:
        why = _why_others(folder, plan, rows)
        raise StateError(f"{row['key']}: {why}; fly the sweep again")
    return row, flight


def check_repeated(row: Row, report: Mapping[str, Any]) -> None:
    """Raise an InvalidRunError if the repeated flight of a row has other records."""
    if row["records_sha256"] != report["records_sha256"]:
        why = "other records, though no file of its key has changed: the processor or a package has"
        raise InvalidRunError(f"{row['key']}: {why}, or a plug-in uses what is in no key")


# Reading a sweep that is done, or under way.


class Flown(NamedTuple):
    """The rows of a sweep in the order of its grid."""

    rows: list[Row]
    units: dict[str, str]  # metric -> unit
    axes: dict[str, list[Any]]  # axis -> its values
    flights: int  # number of all flights

    @property
    def missing(self) -> str:
        """How many flights are missing, in words; "" if none."""
        missing = self.flights - len(self.rows)
        return f"{missing} flights are not done" if missing else ""


def read_sweep(folder: Path) -> Flown:
    """Read the rows of a sweep in the order of its grid.

    Raise a StateError if a row has another point than those of the sweep. Warn if the rows are
    of more than one code, whose difference may be what the rows show.
    """
    summary, rows = read_summary(folder), read_rows(folder)
    baselines = summary.get("baselines", {})
    rows = normalise(rows, baselines)
    codes = {str(row.get("code")) for row in rows.values()}
    if len(codes) > 1:
        text = f"{folder}: its flights are of different code: {' and '.join(sorted(codes))}"
        logging.getLogger("cloudrc").warning("%s", to_one_line(text))
    axes: dict[str, list[Any]] = summary["axes"]

    def place(row: Row) -> list[int]:
        return [*(axes[axis].index(row["point"][axis]) for axis in axes), row["seed"]]

    try:
        ordered = sorted(rows.values(), key=place)
    except (KeyError, ValueError):
        text = f"has rows of another grid than that in {SUMMARY}; name the folder of one sweep"
        raise StateError(f"{folder}: {text}") from None
    unknown = dict.fromkeys((name for row in ordered for name in row["numbers"]), "")
    count = summary["flights"] - len(added(baselines))
    return Flown(ordered, {**unknown, **summary["units"]}, axes, count)


def read_flights(folder: Path) -> Flown:
    """Read a sweep that has rows; values of axes that are neither numbers nor text become text."""
    found = read_sweep(folder)
    if not found.rows:
        raise NothingFlownError(f"{folder}: has no rows; run the sweep again with this --out")
    for row in found.rows:
        row["point"] = {
            axis: value if type(value) in (str, int, float) else json.dumps(value)
            for axis, value in row["point"].items()
        }
    return found


def count_by_value(found: Flown) -> list[dict[str, Any]]:
    """Return the flights and successes per value of an axis."""
    of_value = [
        (axis, value, [row for row in found.rows if row["point"][axis] == value])
        for axis, choices in found.axes.items()
        for value in choices
    ]
    return [
        {"axis": axis, "value": value, "flights": len(own), "success": count_successes(own)}
        for axis, value, own in of_value
    ]


def status_text(found: Flown, counts: Sequence[Mapping[str, Any]]) -> str:
    """Format the state of a sweep for people; `counts` are those of `count_by_value`."""
    verdicts = count_verdicts(found.rows)
    text = f"{len(found.rows)} of {found.flights} flights are done: {verdicts}"
    if not counts:
        return text
    cells = [("axis", "value", "success")]
    for each in counts:
        share = f"{each['success']}/{each['flights']}"
        cells.append((each["axis"], as_text(each["value"]), share))
    return f"{text}\n\n{table(cells, right=(2,))}"
