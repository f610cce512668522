"""Fly an experiment with the seeds 1 to N, which is a sweep of one point, and summarise it."""

from __future__ import annotations

import statistics
from collections.abc import Generator, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

from cloudrc.config.overrides import parse_settings
from cloudrc.outside.document import write_yaml
from cloudrc.runs import store
from cloudrc.runs.flight import Row, counts, measure
from cloudrc.runs.grid import Grid, SweepPoint, read_grid
from cloudrc.runs.workers import map_in_order
from cloudrc.statistics import median_interval
from cloudrc.text import FAILED_MARK, FAILED_NOTE, format_number, table

METHOD = "95 % interval of the median, by order statistics"


def write_grid(folder: Path, experiment: str, settings: Sequence[str], seeds: int) -> Grid:
    """Write the file of the sweep into its folder, and return the grid.

    `experiment` is a name or the path of a file, `settings` are texts KEY=VALUE.
    """
    values = {".".join(path): each.value for path, each in parse_settings(settings).items()}
    file = {"experiment": experiment, "set": values, "seeds": seeds, "folder": str(Path.cwd())}
    (folder / store.FILE).write_text(write_yaml(file), "utf-8")
    return read_grid(folder / store.FILE)


def fly_seeds(grid: Grid) -> Generator[Row]:
    """Fly all seeds, one per core at a time; yield the row of each, in order."""
    flights = [*grid.flights.values()]
    return map_in_order(fly_seed, flights, len(flights))


def fly_seed(flight: SweepPoint) -> Row:
    """Fly once; return the row of results, such as the verdict. An exception ends the command."""
    return flight.row(measure(flight.experiment))


def summarise(rows: Sequence[Row], units: Mapping[str, str]) -> dict[str, Any]:
    """Count all runs and successful runs; compute the median of each measurement.

    Each median has a confidence interval. A run whose plug-in failed is counted, but its
    measurements are left out. `units`: metric -> unit.
    """
    valid = [row for row in rows if counts(row)]
    names = dict.fromkeys(name for row in valid for name in row["numbers"])
    done = sum(row["verdict"] == "success" for row in rows)
    numbers = {name: _summarise_one(valid, name, units[name]) for name in names}
    return {"done": done, "count": len(rows), "method": METHOD, "numbers": numbers}


def _summarise_one(rows: Iterable[Row], name: str, unit: str) -> dict[str, Any]:
    """Return median and interval of a measurement, of how many runs, and how many had failed."""
    having = [row for row in rows if name in row["numbers"]]
    found = [row["numbers"][name] for row in having]
    return {
        "median": statistics.median(found),
        "interval": median_interval(found),
        "unit": unit,
        "count": len(found),
        "failed": sum(row["verdict"] != "success" for row in having),
    }


def as_table(summary: Mapping[str, Any], planned: int = 0) -> str:
    """Format the result of `summarise` as a table; the last line counts the successful runs.

    `planned` is the number of runs to fly, if it is larger than that of the runs that have flown.
    """
    rows = [("number", "median", "95 % interval", "unit")]
    for name, entry in summary["numbers"].items():
        rows.append(_row(name, entry, summary["count"]))
    method = METHOD if summary["count"] >= 6 else "an interval needs 6 seeds or more"
    if any(entry["failed"] for entry in summary["numbers"].values()):
        method += f"\n{FAILED_NOTE}"
    count = planned or summary["count"]
    return f"{table(rows, right=(1, 2))}\n\n{method}\ndone {summary['done']}/{count}"


def _row(name: str, entry: Mapping[str, Any], count: int) -> tuple[str, str, str, str]:
    """Return the row of a number; `count` is that of all runs."""
    between = " .. ".join(map(format_number, entry["interval"] or ())) or "-"
    unit = "" if entry["unit"] == "1" else entry["unit"]
    note = "" if entry["count"] == count else f"  ({entry['count']} runs)"
    mark = FAILED_MARK if entry["failed"] else ""
    return name, format_number(entry["median"]) + mark, between, unit + note
