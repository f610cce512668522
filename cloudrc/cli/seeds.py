"""`cloudrc run --seeds N`: fly seeds 1 to N on all cores; print medians and their intervals."""

from __future__ import annotations

import argparse
import json
import statistics
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, TypeAlias

from cloudrc.cli.advice import warn
from cloudrc.cli.output import escape, format_document, format_number, print_or_drop, table
from cloudrc.cli.pool import map_in_order, take_each
from cloudrc.cli.report import print_traceback
from cloudrc.cli.run import fly, load, new_folder
from cloudrc.config.load import ResolvedExperiment
from cloudrc.metrics.verdict import exit_code
from cloudrc.sweep import store
from cloudrc.sweep.flight import Row, counts
from cloudrc.sweep.statistics import median_interval

Report: TypeAlias = Mapping[str, Any]
"""Content of a file report.json."""
METHOD = "95 % interval of the median, by order statistics"


def summarise(reports: Sequence[Report]) -> dict[str, Any]:
    """Count all runs and successful runs; compute median and interval of each measurement.

    Runs that were interrupted or whose plug-in failed have no numbers here.
    """
    numbers, measured = {}, [each for each in reports if counts(_row(each))]
    for name, unit in _units(measured).items():
        found = [r["numbers"][name]["value"] for r in measured if name in r["numbers"]]
        middle = {"median": statistics.median(found), "interval": median_interval(found)}
        numbers[name] = {**middle, "unit": unit, "count": len(found)}
    done = sum(report["verdict"] == "success" for report in reports)
    return {"done": done, "count": len(reports), "method": METHOD, "numbers": numbers}


def _row(report: Report) -> Row:
    """Make the row of a run, as in a sweep."""
    return {
        **{"seed": report["seed"], "verdict": report["verdict"]},
        "failures": [failure["code"] for failure in report["failures"]],
        "numbers": {name: number["value"] for name, number in report["numbers"].items()},
    }


def _units(reports: Sequence[Report]) -> dict[str, str]:
    return {name: e["unit"] for report in reports for name, e in report["numbers"].items()}


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


def as_csv(reports: Sequence[Report]) -> str:
    """Format reports as CSV, one line per run: seed, verdict and all measurements."""
    units, rows = _units(reports), [*map(_row, reports)]
    columns = {name: [row[name] for row in rows] for name in ("seed", "verdict")}
    columns |= {name: [row["numbers"].get(name) for row in rows] for name in units}
    return store.as_csv(columns, units)


def fly_seeds(options: argparse.Namespace) -> int:
    """Fly seeds 1 to N and print one table; return 0 if all runs succeed.

    If Ctrl-C or a killed worker ends the command early, the table shows the finished seeds only.
    """
    experiment = load(options.experiment, options.set)
    warn(experiment)
    name = experiment.name
    folder = new_folder(options.out, f"{name}-virtual-{options.seeds}seeds", "latest-sweep")
    seeds = range(1, options.seeds + 1)
    work = [(experiment.model_copy(update={"seed": n}), folder / f"seed-{n}") for n in seeds]
    for_people, reports = options.output == "table", list[dict[str, Any]]()

    def take(report: dict[str, Any]) -> None:
        reports.append(report)
        failure = "".join(f": {f['text']}" for f in report["failures"][:1])
        count = f"{len(reports)}/{len(work)}"
        line = f"{count:>7}  seed {report['seed']}  {report['verdict']}{failure}"
        if for_people or sys.stderr.isatty():
            print_or_drop(escape(line), sys.stdout if for_people else sys.stderr)
        if not any("traceback" in earlier for earlier in reports[:-1]):
            print_traceback(options, report)
        if report["verdict"] == "interrupted":  # Ctrl-C in this process, which flies on one core
            raise KeyboardInterrupt

    stopped, code = take_each(map_in_order(_fly_one, work, len(work)), take)
    if stopped:
        text = f"\ncloudrc: {stopped}: {len(reports)} of {len(work)} seeds are finished"
        print_or_drop(text, sys.stderr)
    document = {
        **{"schemaVersion": 1, "experiment": name, "mode": "virtual", "interrupted": bool(stopped)},
        "overrides": list(options.set),
        **summarise(reports),
        "runs": [
            {"seed": r["seed"], "verdict": r["verdict"], "folder": f"seed-{r['seed']}"}
            for r in reports
        ],
    }
    (folder / "sweep.json").write_text(json.dumps(document, indent=2) + "\n")
    (folder / "sweep.csv").write_text(as_csv(reports))
    shown = f"\n{as_table(document)}\n\n{folder / 'sweep.json'}"
    print_or_drop(shown if for_people else format_document(document, options.output))
    return code or max(map(exit_code, reports))


def _fly_one(job: tuple[ResolvedExperiment, Path]) -> dict[str, Any]:
    experiment, folder = job
    folder.mkdir()
    return fly(experiment, "virtual", folder, page=False)
