"""`cloudrc faults list` and `run`: scenarios by name, their results as text, JSON and JUnit."""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from typing import TYPE_CHECKING

from cloudrc.cli.extras import require
from cloudrc.cli.output import harmless, paint, table, written
from cloudrc.cli.pool import WorkerDiedError, in_order
from cloudrc.errors import BadInputError

if TYPE_CHECKING:
    from cloudrc.faults.document import Result
    from cloudrc.faults.scenario import Mode, Scenario

COLOURS = {"passed": "green", "FAILED": "red", "skipped": "yellow"}
FAILED, INTERRUPTED = 1, 130
PLACE = ("context", "namespace", "release")
"""Flags that name a place in a cluster."""


def show(options: argparse.Namespace) -> int:
    """List the faults."""
    from cloudrc.faults.catalogue import scenarios

    found = scenarios(_mode(options) if options.real or options.cluster else None)
    if options.output != "table":
        names = ("id", "name", "mode", "injects", "expects", "loses", "shows")
        faults = [{n: getattr(each, n) for n in names} for each in found]
        print(written({"schemaVersion": 1, "faults": faults}, options.output))
        return 0
    rows = [("fault", "name", "mode", "what is done", "what has to follow")]
    rows += [(each.id, each.name, each.mode, each.injects, each.expects) for each in found]
    print(table(rows))
    return 0


def run(options: argparse.Namespace) -> int:
    """Run one fault or all of them; 1 if a check did not pass, 130 if interrupted."""
    from cloudrc.faults import document
    from cloudrc.faults.catalogue import called, scenarios

    mode = _mode(options)
    if options.document is not None and not options.all:
        raise BadInputError("--document writes a page of all faults: add --all in place of a name")
    if mode == "cluster":
        _look_for_release(options)
    elif any(_place(options).values()):
        flags = ", ".join(f"--{name}" for name in PLACE)
        raise BadInputError(f"{flags} say which robot of a cluster: add --cluster")
    chosen = scenarios(mode) if options.all else called(options.name, mode)
    say = print if options.output == "table" else _silent
    results, cause, code = [], "", 0
    try:
        for result in _results(chosen, options):
            results.append(result)
            _say(result, options.all, say)
    except KeyboardInterrupt:
        cause, code = "interrupted", INTERRUPTED
    except WorkerDiedError as error:
        cause, code = str(error), error.exit_code
    if options.junit is not None:
        options.junit.write_text(document.as_junit(results, options.seed), encoding="utf-8")
    if options.document is not None and not cause:
        text = document.as_markdown(results, options.seed, mode)
        options.document.write_text(text, encoding="utf-8")
    if options.output != "table":
        print(written(document.as_json(results, options.seed), options.output))
    failed = sum(result.failed for result in results)
    passed = sum(result.passed for result in results)
    say(f"\nseed {options.seed}: {passed} of {len(results)} passed, {failed} failed")
    if cause:
        told = f"cloudrc: {cause}; {len(results)} of {len(chosen)} were run before"
        print(told, file=sys.stderr, flush=True)
    return code or (FAILED if failed else 0)


def _look_for_release(options: argparse.Namespace) -> None:
    """Say it once, and not with every fault, if there is no cluster or no release in it."""
    require("faults in a cluster", ("kube",))
    from cloudrc.cluster.pods import find_pod
    from cloudrc.faults.cluster.release import place, release_there

    place.update(_place(options))
    find_pod(release_there(), "world")


def _place(options: argparse.Namespace) -> dict[str, str | None]:
    return {name: getattr(options, name) for name in PLACE}


def _mode(options: argparse.Namespace) -> Mode:
    return "cluster" if options.cluster else "real" if options.real else "virtual"


def _results(chosen: Sequence[Scenario], options: argparse.Namespace) -> Iterator[Result]:
    names = [(each.name, each.mode, options.seed) for each in chosen]
    jobs = options.jobs if _mode(options) == "virtual" else 1
    return in_order(_run, names, jobs)


def _run(which: tuple[str, Mode, int]) -> Result:
    """Run one, in this process or in one of a pool; what breaks it is part of the result."""
    from cloudrc.faults.catalogue import find
    from cloudrc.faults.document import Result
    from cloudrc.faults.scenario import Outcome

    name, mode, seed = which
    scenario, began = find(name, mode), time.monotonic()
    try:
        return Result(scenario, scenario.run(seed), time.monotonic() - began)
    except Exception as error:  # a broken scenario has failed, and the others still run
        text = f"{type(error).__name__}: {error}"
        return Result(scenario, Outcome(), time.monotonic() - began, text)


def _say(result: Result, briefly: bool, say: Callable[[str], object]) -> None:
    scenario, outcome = result.scenario, result.outcome
    word = paint(result.word, COLOURS[result.word])
    sha = f"  {outcome.sha256[:12]}" if outcome.sha256 else ""
    say(f"{word:8} {scenario.id:4} {scenario.name:26} {result.seconds:6.1f} s{sha}")
    for reason in filter(None, (result.error, outcome.skipped)):
        say(f"           {harmless(reason)}")
    shown: Iterable[str] = (
        f"         {'' if check.passed else 'x '}{harmless(check.show())}"
        for check in outcome.checks
        if not (briefly and check.passed)
    )
    for line in shown:
        say(line)


def _silent(text: str) -> None:
    """Nothing but JSON on stdout."""
