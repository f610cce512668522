"""`cloudrc run --seeds N`: fly one experiment with N seeds; print medians and their intervals."""

from __future__ import annotations

import argparse
import statistics
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from cloudrc.cli.advice import warn
from cloudrc.cli.output import escape, format_number, print_or_drop, print_result, table
from cloudrc.cli.pool import map_in_order, take_each
from cloudrc.cli.report import print_traceback
from cloudrc.cli.run import load, new_folder
from cloudrc.config.document import write_yaml
from cloudrc.config.overrides import parse_settings
from cloudrc.metrics.verdict import EXIT_CODES
from cloudrc.sweep import store
from cloudrc.sweep.flight import Row, counts, measure
from cloudrc.sweep.plan import Flight, read_plan
from cloudrc.sweep.statistics import median_interval

METHOD = "95 % interval of the median, by order statistics"


def summarise(rows: Sequence[Row], units: Mapping[str, str]) -> dict[str, Any]:
    """Count all runs and successful runs; compute the median of each measurement.

    Each median has a confidence interval. A run whose plug-in failed is counted, but its
    measurements are left out. `units`: metric -> unit.
    """
    numbers, measured = {}, [row["numbers"] for row in rows if counts(row)]
    for name in dict.fromkeys(name for each in measured for name in each):
        found = [each[name] for each in measured if name in each]
        middle = {"median": statistics.median(found), "interval": median_interval(found)}
        numbers[name] = {**middle, "unit": units[name], "count": len(found)}
    done = sum(row["verdict"] == "success" for row in rows)
    return {"done": done, "count": len(rows), "method": METHOD, "numbers": numbers}


def as_table(summary: Mapping[str, Any]) -> str:
    """Format the result of `summarise` as a table; the last line counts the successful runs."""
    rows = [("number", "median", "95 % interval", "unit")]
    for name, entry in summary["numbers"].items():
        between = " .. ".join(map(format_number, entry["interval"] or ())) or "-"
        unit = "" if entry["unit"] == "1" else entry["unit"]
        note = "" if entry["count"] == summary["count"] else f"  ({entry['count']} runs)"
        rows.append((name, format_number(entry["median"]), between, unit + note))
    method = METHOD if summary["count"] >= 6 else "an interval needs 6 seeds or more"
    return f"{table(rows, right=(1, 2))}\n\n{method}\ndone {summary['done']}/{summary['count']}"


def fly_seeds(options: argparse.Namespace) -> int:
    """Fly seeds 1 to N and print one table; return 0 if all runs succeed.

    If Ctrl-C or a killed worker ends the command early, the table shows the finished seeds only.
    """
    experiment = load(options.experiment, options.set)
    warn(experiment)
    name = experiment.name
    folder = new_folder(options.out, f"{name}-virtual-{options.seeds}seeds", "latest-sweep")
    settings = {".".join(path): each.value for path, each in parse_settings(options.set).items()}
    settings.pop("seed", None)
    file = {"experiment": options.experiment, "set": settings, "seeds": options.seeds}
    (folder / store.FILE).write_text(write_yaml(file | {"folder": str(Path.cwd())}), "utf-8")
    plan, rows = read_plan(folder / store.FILE), list[Row]()
    for_people, work = options.output == "table", [*plan.flights.values()]
    store.begin(folder, plan)
    with store.append_rows(folder, None) as append:

        def take(row: Row) -> None:
            append(row)
            rows.append(row)
            failure = f": {row['text']}" if row["failures"] else ""
            count = f"{len(rows)}/{len(work)}"
            line = f"{count:>7}  seed {row['seed']}  {row['verdict']}{failure}"
            if for_people or sys.stderr.isatty():
                print_or_drop(escape(line), sys.stdout if for_people else sys.stderr)
            if not any("traceback" in earlier for earlier in rows[:-1]):
                print_traceback(options, row)

        stopped, code = take_each(map_in_order(fly_one, work, len(work)), take)
    store.finish(folder, plan)
    if stopped:
        text = f"\ncloudrc: {stopped}: {len(rows)} of {len(work)} seeds are finished"
        print_or_drop(text, sys.stderr)
    document = {
        **{"experiment": name, "mode": "virtual", "interrupted": bool(stopped)},
        "overrides": list(options.set),
        **summarise(rows, store.read_summary(folder)["units"]),
        "runs": [{key: row[key] for key in ("seed", "verdict", "key")} for row in rows],
    }
    text = f"\n{as_table(document)}\n\n{folder / store.SUMMARY}"
    print_result(options.output, document, text)
    return code or max(EXIT_CODES[row["verdict"]] for row in rows)


def fly_one(flight: Flight) -> Row:
    """Fly once and return the row of numbers; an exception ends the command."""
    return store.make_row(flight, measure(flight.experiment))
