"""`cloudrc run --seeds N`: one experiment under N seeds, on all cores, becomes one table.

Many reports of one experiment become one table: medians with their intervals.
"""

from __future__ import annotations

import argparse
import csv
import io
import json
import math
import multiprocessing
import os
import signal
import statistics
import sys
from collections.abc import Generator, Iterator, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from concurrent.futures.process import BrokenProcessPool
from contextlib import closing, contextmanager
from itertools import islice
from pathlib import Path
from typing import Any, TypeAlias

from cloudrc.cli.find_run import new_folder
from cloudrc.cli.output import number, say, table, unread_is_fine, written
from cloudrc.cli.pool import AHEAD, KILLED, WorkerDiedError, end_with
from cloudrc.cli.summary import EXIT_CODES

Report: TypeAlias = Mapping[str, Any]
"""A `report.json`."""

CONFIDENCE = 0.95
METHOD = "95 % interval of the median, by order statistics"


def interval(values: Sequence[float]) -> tuple[float, float] | None:
    """Bound the median of what the values were drawn from, without assuming a distribution.

    The k-th smallest and the k-th largest of n values enclose the median with probability
    1 - 2 * sum_{i<k} C(n, i) / 2^n; k is the largest for which that is at least 95 %.

    Source: H. A. David, H. N. Nagaraja, Order Statistics, 3rd ed., 2003, section 7.1.

    Returns:
        Lower and upper bound, or None for fewer than 6 values, which cannot tell.
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
    """Give done, count, and per number its median, interval, unit and how many runs have it."""
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
    """Lay a summary out: number, median, interval, unit, and below how many runs were done."""
    rows = [("number", "median", "95 % interval", "unit")]
    for name, entry in summary["numbers"].items():
        bounds = entry["interval"]
        between = f"{number(bounds[0])} .. {number(bounds[1])}" if bounds else "-"
        unit = "" if entry["unit"] == "1" else entry["unit"]
        note = "" if entry["count"] == summary["count"] else f"  ({entry['count']} runs)"
        rows.append((name, number(entry["median"]), between, unit + note))
    enough = any(entry["interval"] for entry in summary["numbers"].values())
    method = METHOD if enough else "an interval needs 6 seeds or more"
    return f"{table(rows, right=(1, 2))}\n\n{method}\ndone {summary['done']}/{summary['count']}"


def as_csv(reports: Sequence[Report]) -> str:
    """Write one line per run: seed, verdict, and every number that any run has."""
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


def fly_seeds(options: argparse.Namespace, overrides: list[str]) -> int:
    """Fly seeds 1 to N; exit 0 only if each of them succeeds.

    Who interrupts gets the table of the seeds that are finished; so does who loses a worker.
    """
    from cloudrc import metrics
    from cloudrc.config.load import load_experiment

    # Loaded here too: a mistake is told once, not N times.
    loaded = load_experiment(options.experiment, overrides)
    metrics.check(loaded.report.metrics)
    name = loaded.name
    folder = new_folder(options.out, f"{name}-virtual-{options.seeds}seeds")
    seeds = range(1, options.seeds + 1)
    reports: list[dict[str, Any]] = []
    code = 0
    try:
        with closing(_reports(options.experiment, overrides, folder, seeds)) as finished:
            for report in finished:
                reports.append(report)
                _tell(options, report, f"{len(reports)}/{len(seeds)}")
    except (KeyboardInterrupt, BrokenProcessPool) as error:
        killed = isinstance(error, BrokenProcessPool)
        code = WorkerDiedError.exit_code if killed else EXIT_CODES["interrupted"]
        told = f"{KILLED if killed else 'interrupted'}: {len(reports)} of {len(seeds)} seeds"
        with unread_is_fine(sys.stderr):
            print(f"\ncloudrc: {told} are finished", file=sys.stderr, flush=True)
    reports.sort(key=lambda report: int(report["seed"]))
    summary = _write(folder, name, reports, bool(code))
    with unread_is_fine(sys.stdout):
        if options.output != "table":
            document = json.loads((folder / "sweep.json").read_text())
            print(written(document, options.output), flush=True)
        else:
            print(f"\n{as_table(summary)}\n\n{folder / 'sweep.json'}", flush=True)
    return code or max(EXIT_CODES[report["verdict"]] for report in reports)


def _tell(options: argparse.Namespace, report: dict[str, Any], count: str) -> None:
    stream = sys.stdout if options.output == "table" else sys.stderr
    if options.output == "table" or stream.isatty():
        failures = "".join(f": {f['text']}" for f in report["failures"][:1])
        with unread_is_fine(stream):
            say(f"{count:>7}  seed {report['seed']}  {report['verdict']}{failures}", stream)


def _reports(
    experiment: str, overrides: list[str], folder: Path, seeds: range
) -> Generator[dict[str, Any]]:
    """Fly every seed; reports come as they are finished. Who stops listening ends the flights."""
    # Spawned, not forked: a child starts clean, whatever threads the libraries here have begun.
    context = multiprocessing.get_context("spawn")
    workers = min(os.cpu_count() or 1, len(seeds))
    with _born_apart():  # it begins a process that sweeps up behind the others
        pool = ProcessPoolExecutor(workers, context, end_with, (os.getpid(),))
    with pool:
        try:
            left = (pool.submit(_fly_one, experiment, overrides, folder, seed) for seed in seeds)
            while True:
                with _born_apart():
                    flying = list(islice(left, AHEAD))
                if not flying:
                    break
                for future in as_completed(flying):
                    yield future.result()
        except BaseException:
            pool.shutdown(wait=False, cancel_futures=True)
            # Leaving `with` waits for the workers, and they for the end of their flights.
            for worker in multiprocessing.active_children():
                worker.terminate()
            raise


@contextmanager
def _born_apart() -> Iterator[None]:
    """Let processes that begin here be disturbed by nobody but their parent, which ends them.

    They ignore what a terminal sends to all of a group: a signal that is ignored stays so across
    the start of a program. Until they have their parent's path, they take no Python from the
    working folder, which may be a run got from somebody else.
    """
    numbers = (signal.SIGINT, signal.SIGHUP)
    before = [signal.signal(number, signal.SIG_IGN) for number in numbers]
    safe = os.environ.get("PYTHONSAFEPATH")
    os.environ["PYTHONSAFEPATH"] = "1"
    try:
        yield
    finally:
        if safe is None:
            del os.environ["PYTHONSAFEPATH"]
        else:
            os.environ["PYTHONSAFEPATH"] = safe
        for number, handler in zip(numbers, before, strict=True):
            signal.signal(number, handler)


def _fly_one(experiment: str, overrides: list[str], folder: Path, seed: int) -> dict[str, Any]:
    from cloudrc.cli.flight import fly
    from cloudrc.config.load import load_experiment

    loaded = load_experiment(experiment, [*overrides, f"seed={seed}"])
    own = folder / f"seed-{seed}"
    own.mkdir()
    return fly(loaded, "virtual", own, lambda records: None, page=False)


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
