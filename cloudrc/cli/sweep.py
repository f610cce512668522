"""`cloudrc run --seeds N`: one experiment under N seeds, on all cores, becomes one table."""

from __future__ import annotations

import argparse
import json
import multiprocessing
import os
import signal
import sys
from collections.abc import Generator, Iterator
from concurrent.futures import ProcessPoolExecutor, as_completed
from concurrent.futures.process import BrokenProcessPool
from contextlib import closing, contextmanager
from itertools import islice
from pathlib import Path
from typing import Any

from cloudrc.cli.closing import EXIT_CODES
from cloudrc.cli.folder import new_folder
from cloudrc.cli.output import say, unread_is_fine, written
from cloudrc.cli.pool import AHEAD, KILLED, WorkerDiedError
from cloudrc.cli.signals import end_with
from cloudrc.cli.statistics import as_csv, as_table, summarise


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
