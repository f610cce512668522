"""Run `cloudrc faults fuzz` and `replay`: fly random or stored schedules of faults."""

from __future__ import annotations

import argparse
import signal
import sys
import time
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from dataclasses import asdict
from pathlib import Path
from types import FrameType
from typing import TYPE_CHECKING, Any

from cloudrc.cli import faults_summary as page
from cloudrc.cli.output import format_document, ignore_closed_pipe, paint, print_line, table
from cloudrc.cli.pool import WorkerDiedError, map_in_order
from cloudrc.errors import BadInputError

if TYPE_CHECKING:
    from cloudrc.faults.fuzz import Finding
    from cloudrc.faults.schedule import Schedule

FAILED = 1
INTERRUPTED = 130
PROGRESS_PERIOD = 10.0
"""Pause between two lines of progress [s]."""


def fuzz(options: argparse.Namespace) -> int:
    """Fly random schedules; return 1 if an invariant broke, 130 if stopped, 6 if killed."""
    say = options.output == "table"
    search = Search(options)
    cause, code = "stopped", INTERRUPTED
    with stop_on_signal() as stop:
        try:
            _fly_all(search, say, stop)
        except WorkerDiedError as error:
            if not stop():  # else the same signal has ended the worker
                cause, code = str(error), error.exit_code
    document, partial = search.document(), len(search.findings) < options.seeds
    if partial and not search.findings:
        print(f"cloudrc: {cause}; no schedule was flown", file=sys.stderr)
        return code
    if options.document is not None and not partial:
        written_by = f"{page.command(document)} --document {options.document}"
        options.document.write_text(page.markdown(document, written_by), encoding="utf-8")
    if partial:
        rest = page.command(document | _rest(document, options))
        message = f"{cause}; {document['count']} of {options.seeds} were flown"
        with ignore_closed_pipe(sys.stderr):  # a closed terminal must not prevent the output below
            print(f"cloudrc: {message}; continue with '{rest}'", file=sys.stderr, flush=True)
    _print(document, options)
    return code if partial else FAILED if search.failures else 0


def _print(document: dict[str, Any], options: argparse.Namespace) -> None:
    if options.output == "table":
        print("\n" + table(page.rows(document), right=(1, 2)))
        print(f"\n{page.summary(document)}")
    else:
        print(format_document(document, options.output))


def _rest(document: dict[str, Any], options: argparse.Namespace) -> dict[str, int]:
    """Return the range of seeds that were not flown."""
    count = document["count"]
    return {"first": options.first + count, "count": options.seeds - count}


def _fly_all(search: Search, say: bool, stop: Callable[[], bool]) -> None:
    """Fly all schedules in the order of the seeds, until done or stopped."""
    options, printed = search.options, time.monotonic()
    seeds = range(options.first, options.first + options.seeds)
    for finding in _findings(seeds, options):
        search.take(finding, say, stop)
        if stop():  # do not print progress: the terminal may be closed
            return
        if say and time.monotonic() - printed > PROGRESS_PERIOD:
            printed = time.monotonic()
            flown, failed = len(search.findings), len(search.failures)
            print(f"{flown} of {options.seeds} flown, {failed} failed", flush=True)


class Search:
    """Collect the flights so far, of consecutive seeds from the first one."""

    def __init__(self, options: argparse.Namespace) -> None:
        """Start the search with the options of the command."""
        self.options, self._began = options, time.monotonic()
        self.findings: list[dict[str, Any]] = []
        self.failures: list[dict[str, Any]] = []

    def take(self, finding: Finding, say: bool, stop: Callable[[], bool]) -> None:
        """Add the flight of the next seed; reduce a failing schedule unless stopped."""
        if finding.breaches:
            self.failures.append(_report(finding, self.options.store, say, stop))
        self.findings.append(_brief(finding))

    def document(self) -> dict[str, Any]:
        """Summarise all flights as plain values."""
        return page.document(
            self.findings,
            self.failures,
            kind=_kind(self.options),
            first=self.options.first,
            seconds=time.monotonic() - self._began,
        )


@contextmanager
def stop_on_signal() -> Iterator[Callable[[], bool]]:
    """Turn the first signal into a request to stop after the current flight; the second kills.

    A closed terminal sends two signals, which count as one. Under `nohup`, SIGHUP stays ignored.
    """
    received: list[int] = []
    numbers = [signal.SIGINT, signal.SIGTERM]
    if signal.getsignal(signal.SIGHUP) is not signal.SIG_IGN:
        numbers.append(signal.SIGHUP)

    def request_stop(number: int, frame: FrameType | None) -> None:
        received.append(number)
        for each in numbers:
            hung_up = each == signal.SIGHUP
            signal.signal(each, signal.SIG_IGN if hung_up else signal.default_int_handler)

    before = [signal.signal(number, request_stop) for number in numbers]
    try:
        yield lambda: bool(received)
    finally:
        for number, handler in zip(numbers, before, strict=True):
            signal.signal(number, handler)


def replay(options: argparse.Namespace) -> int:
    """Fly a stored schedule; return 1 if an invariant breaks."""
    from cloudrc.faults.fuzz import fly
    from cloudrc.faults.schedule import load

    try:
        finding = fly(load(options.file), keep=True)
    except BadInputError as error:  # an unknown profile or policy
        where = "" if str(options.file) in str(error) else f"{options.file}: "
        raise BadInputError(f"{where}{error}") from error
    breaches = [breach._asdict() for breach in finding.breaches]
    if options.output != "table":
        document = {"schemaVersion": 1, "records_sha256": finding.sha256, "breaches": breaches}
        print(format_document(document, options.output))
    else:
        for breach in finding.breaches:
            print_line(f"{breach.time:8.3f} s  {breach.kind}: {breach.text}")
        print(f"{'FAILED' if breaches else 'passed'}  records {finding.sha256[:16]}")
    return FAILED if breaches else 0


def _findings(seeds: Iterable[int], options: argparse.Namespace) -> Iterator[Finding]:
    work = [(seed, _kind(options)) for seed in seeds]
    return map_in_order(_fly, work, options.jobs)


def _kind(options: argparse.Namespace) -> str:
    return "adversarial" if options.adversarial else "clean" if options.clean else "random"


def _fly(job: tuple[int, str]) -> Finding:
    from cloudrc.faults.adversary import choose
    from cloudrc.faults.fuzz import fly
    from cloudrc.faults.schedule import calm, compose

    seed, kind = job
    return fly({"adversarial": choose, "clean": calm, "random": compose}[kind](seed))


def _brief(finding: Finding) -> dict[str, Any]:
    from cloudrc.faults.fuzz import judged

    return {
        "judged": judged(finding.schedule),
        "kinds": finding.kinds,
        "margin": finding.margin,
        "speed": finding.speed,
        "holds": finding.holds,
        "missions": finding.missions,
        "fallen": finding.fallen,
        "thrown": finding.thrown,
        "landed_on": bool(finding.landed_on),
        "duration": finding.schedule.duration,
    }


def _report(finding: Finding, store: Path, say: bool, stop: Callable[[], bool]) -> dict[str, Any]:
    """Reduce a failing schedule, unless stopped; print and store it."""
    from cloudrc.faults.fuzz import fly
    from cloudrc.faults.schedule import dump, shrink

    kinds = finding.kinds

    def fails(schedule: Schedule) -> bool:
        return not stop() and bool(fly(schedule).kinds & kinds)

    smallest = shrink(finding.schedule, fails)
    breaches = fly(smallest).breaches
    note = "\n".join(f"{b.time:.3f} s: {b.kind}: {b.text}" for b in breaches[:3])
    text = dump(smallest, f"Found by seed {finding.schedule.seed}.\n{note}")
    if say and not stop():
        print(f"\n{paint('FAILED', 'red')} seed {finding.schedule.seed}\n{text}", flush=True)
    name = f"{'-'.join(sorted(kinds))}-{smallest.policy or 'seed'}-{smallest.seed}"
    path = _keep(text, store, name)
    return {
        "seed": finding.schedule.seed,
        "breaches": [breach._asdict() for breach in finding.breaches],
        "schedule": asdict(smallest),
        "file": str(path),
    }


def _keep(text: str, store: Path, name: str) -> Path:
    """Store a schedule; never overwrite a different one of the same name."""
    store.mkdir(parents=True, exist_ok=True)
    path, number = store / f"{name}.yaml", 2
    while path.exists() and path.read_text(encoding="utf-8") != text:
        path, number = store / f"{name}-{number}.yaml", number + 1
    path.write_text(text, encoding="utf-8")
    return path
