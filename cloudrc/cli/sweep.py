"""`cloudrc run --seeds N`: one experiment under N seeds, on all cores, becomes one table."""

from __future__ import annotations

import argparse
import json
import multiprocessing
import os
import sys
from collections.abc import Iterator
from concurrent.futures import Future, ProcessPoolExecutor, as_completed
from pathlib import Path
from typing import Any

from cloudrc.cli.closing import EXIT_CODES
from cloudrc.cli.folder import new_folder
from cloudrc.cli.statistics import as_csv, as_table, summarise


def fly_seeds(options: argparse.Namespace, overrides: list[str]) -> int:
    """Fly seeds 1 to N; exit 0 only if each of them succeeds."""
    from cloudrc.config.load import load_experiment

    # Loaded here too: a mistake is told once, not N times.
    name = load_experiment(options.experiment, overrides).name
    folder = new_folder(options.out, f"{name}-virtual-{options.seeds}seeds")
    seeds = range(1, options.seeds + 1)
    stream = sys.stderr if options.output == "json" else sys.stdout
    reports = []
    for report in _reports(options.experiment, overrides, folder, seeds):
        reports.append(report)
        if options.output == "table" or stream.isatty():
            failures = "".join(f": {f['text']}" for f in report["failures"][:1])
            count = f"{len(reports)}/{len(seeds)}"
            line = f"{count:>7}  seed {report['seed']}  {report['verdict']}{failures}"
            print(line, file=stream, flush=True)
    reports.sort(key=lambda report: int(report["seed"]))
    summary = _write(folder, name, reports)
    if options.output == "json":
        print((folder / "sweep.json").read_text(), end="")
    else:
        print(f"\n{as_table(summary)}\n\n{folder / 'sweep.json'}")
    return max(EXIT_CODES[report["verdict"]] for report in reports)


def _reports(
    experiment: str, overrides: list[str], folder: Path, seeds: range
) -> Iterator[dict[str, Any]]:
    """Fly every seed; reports come as they are finished."""
    # Spawned, not forked: a child starts clean, whatever threads the libraries here have begun.
    context = multiprocessing.get_context("spawn")
    workers = min(os.cpu_count() or 1, len(seeds))
    with ProcessPoolExecutor(workers, context) as pool:
        futures: list[Future[dict[str, Any]]] = [
            pool.submit(_fly_one, experiment, overrides, folder, seed) for seed in seeds
        ]
        try:
            for future in as_completed(futures):
                yield future.result()
        except BaseException:
            pool.shutdown(wait=False, cancel_futures=True)
            raise


def _fly_one(experiment: str, overrides: list[str], folder: Path, seed: int) -> dict[str, Any]:
    from cloudrc.cli.flight import fly
    from cloudrc.config.load import load_experiment

    loaded = load_experiment(experiment, [*overrides, f"seed={seed}"])
    own = folder / f"seed-{seed}"
    own.mkdir()
    return fly(loaded, "virtual", own, lambda records: None, page=False)


def _write(folder: Path, name: str, reports: list[dict[str, Any]]) -> dict[str, Any]:
    runs = [
        {"seed": r["seed"], "verdict": r["verdict"], "folder": f"seed-{r['seed']}"} for r in reports
    ]
    summary = {"schemaVersion": 1, "experiment": name, "mode": "virtual", **summarise(reports)}
    text = json.dumps({**summary, "runs": runs}, indent=2)
    (folder / "sweep.json").write_text(text + "\n")
    (folder / "sweep.csv").write_text(as_csv(reports))
    return summary
