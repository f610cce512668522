"""`cloudrc run --seeds N`: fly N seeds on all cores; tabulate medians and confidence intervals."""

from __future__ import annotations

import argparse
import csv
import io
import json
import math
import statistics
import sys
from collections.abc import Callable, Mapping, Sequence
from contextlib import closing
from pathlib import Path
from typing import Any, TypeAlias

from cloudrc.cli.find_run import new_folder
from cloudrc.cli.output import format_document, format_number, ignore_closed_pipe, print_line, table
from cloudrc.cli.pool import WORKER_KILLED, WorkerDiedError, map_in_order
from cloudrc.metrics.verdict import EXIT_CODES

Report: TypeAlias = Mapping[str, Any]
"""The content of a `report.json`."""
Fly: TypeAlias = Callable[..., dict[str, Any]]
"""Function like `cloudrc.cli.run.fly`."""
Job: TypeAlias = tuple[Fly, str, list[str], Path, int]
"""Function that flies, experiment, overrides, folder of the sweep, seed."""

CONFIDENCE = 0.95
"""Confidence level of the intervals [1]."""
METHOD = "95 % interval of the median, by order statistics"


def interval(values: Sequence[float]) -> tuple[float, float] | None:
    """Compute the confidence interval of the median, for any distribution.

    The k-th smallest and the k-th largest of n values enclose the median with probability
    1 - 2 · sum_{i<k} C(n, i) / 2^n. k is the largest number for which the probability is at least
    95 %.

    Source: H. A. David, H. N. Nagaraja, Order Statistics, 3rd ed., 2003, section 7.1.

    Returns:
        Lower and upper bound; None for fewer than 6 values, which cannot reach 95 %.
    """
    ordered, n = sorted(values), len(values)
    outside, k = 0.0, 0
    while k < n // 2:
        outside += 2 * math.comb(n, k) / 2**n
        if 1 - outside < CONFIDENCE:
            break
        k += 1
    return (ordered[k - 1], ordered[n - k]) if k else None


def summarise(reports: Sequence[Report]) -> dict[str, Any]:
    """Summarise reports: number of successful runs, of all runs, and statistics per number."""
    units: dict[str, str] = {}
    values: dict[str, list[float]] = {}
    for report in reports:
        for name, entry in report["numbers"].items():
            units[name] = entry["unit"]
            values.setdefault(name, []).append(entry["value"])
    numbers = {
        name: {
            "median": statistics.median(samples),
            "interval": interval(samples),
            "unit": units[name],
            "count": len(samples),
        }
        for name, samples in values.items()
    }
    done = sum(report["verdict"] == "success" for report in reports)
    return {"done": done, "count": len(reports), "method": METHOD, "numbers": numbers}


def as_table(summary: Mapping[str, Any]) -> str:
    """Lay out a summary as a table; the last line is the share of successful runs."""
    rows = [("number", "median", "95 % interval", "unit")]
    for name, entry in summary["numbers"].items():
        bounds = entry["interval"]
        between = f"{format_number(bounds[0])} .. {format_number(bounds[1])}" if bounds else "-"
        unit = "" if entry["unit"] == "1" else entry["unit"]
        note = "" if entry["count"] == summary["count"] else f"  ({entry['count']} runs)"
        rows.append((name, format_number(entry["median"]), between, unit + note))
    enough = any(entry["interval"] for entry in summary["numbers"].values())
    method = METHOD if enough else "an interval needs 6 seeds or more"
    return f"{table(rows, right=(1, 2))}\n\n{method}\ndone {summary['done']}/{summary['count']}"


def as_csv(reports: Sequence[Report]) -> str:
    """Write one line per run: seed, verdict and all numbers."""
    columns = list(dict.fromkeys(name for report in reports for name in report["numbers"]))
    units = {name: e["unit"] for report in reports for name, e in report["numbers"].items()}
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(["seed", "verdict", *(f"{name} [{units[name]}]" for name in columns)])
    for report in reports:
        numbers = report["numbers"]
        values = [numbers[name]["value"] if name in numbers else "" for name in columns]
        writer.writerow([report["seed"], report["verdict"], *values])
    return text.getvalue()


def fly_seeds(options: argparse.Namespace, overrides: list[str], fly: Fly) -> int:
    """Fly seeds 1 to N; return the exit code, which is 0 only if all runs succeed.

    After an interrupt or the death of a worker, the table covers the finished seeds.

    Args:
        options: Flags of `cloudrc run`.
        overrides: Changes of the experiment, as `--set` takes them.
        fly: Flies one experiment and returns its report; a function of a module.
    """
    from cloudrc import metrics
    from cloudrc.config.load import load_experiment

    # Load the experiment here too, so that a mistake is reported once, not N times.
    loaded = load_experiment(options.experiment, overrides)
    metrics.check(loaded.report.metrics)
    name = loaded.name
    folder = new_folder(options.out, f"{name}-virtual-{options.seeds}seeds")
    seeds = range(1, options.seeds + 1)
    reports: list[dict[str, Any]] = []
    code = 0
    work = [(fly, options.experiment, overrides, folder, seed) for seed in seeds]
    try:
        with closing(map_in_order(_fly_one, work, len(seeds))) as finished:
            for report in finished:
                reports.append(report)
                _show_run(options, report, f"{len(reports)}/{len(seeds)}")
                if report["verdict"] == "interrupted":  # with one core, this process flies
                    raise KeyboardInterrupt
    except (KeyboardInterrupt, WorkerDiedError) as error:
        killed = isinstance(error, WorkerDiedError)
        code = WorkerDiedError.exit_code if killed else EXIT_CODES["interrupted"]
        reason = (
            f"{WORKER_KILLED if killed else 'interrupted'}: {len(reports)} of {len(seeds)} seeds"
        )
        with ignore_closed_pipe(sys.stderr):
            print(f"\ncloudrc: {reason} are finished", file=sys.stderr, flush=True)
    summary = _write(folder, name, reports, bool(code))
    with ignore_closed_pipe(sys.stdout):
        if options.output != "table":
            document = json.loads((folder / "sweep.json").read_text())
            print(format_document(document, options.output), flush=True)
        else:
            print(f"\n{as_table(summary)}\n\n{folder / 'sweep.json'}", flush=True)
    return code or max(EXIT_CODES[report["verdict"]] for report in reports)


def _show_run(options: argparse.Namespace, report: dict[str, Any], progress: str) -> None:
    stream = sys.stdout if options.output == "table" else sys.stderr
    if options.output == "table" or stream.isatty():
        failures = "".join(f": {f['text']}" for f in report["failures"][:1])
        with ignore_closed_pipe(stream):
            print_line(
                f"{progress:>7}  seed {report['seed']}  {report['verdict']}{failures}", stream
            )


def _fly_one(job: Job) -> dict[str, Any]:
    """Fly one seed, in a worker."""
    from cloudrc.config.load import load_experiment

    fly, experiment, overrides, folder, seed = job
    loaded = load_experiment(experiment, [*overrides, f"seed={seed}"])
    run_folder = folder / f"seed-{seed}"
    run_folder.mkdir()
    return fly(loaded, "virtual", run_folder, lambda records: None, page=False)


def _write(
    folder: Path, name: str, reports: list[dict[str, Any]], interrupted: bool
) -> dict[str, Any]:
    runs = [
        {"seed": r["seed"], "verdict": r["verdict"], "folder": f"seed-{r['seed']}"} for r in reports
    ]
    head = {"schemaVersion": 1, "experiment": name, "mode": "virtual", "interrupted": interrupted}
    summary = {**head, **summarise(reports)}
    text = json.dumps({**summary, "runs": runs}, indent=2)
    (folder / "sweep.json").write_text(text + "\n")
    (folder / "sweep.csv").write_text(as_csv(reports))
    return summary
