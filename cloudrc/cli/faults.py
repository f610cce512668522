"""Run `cloudrc faults`: inject faults and check how the system reacts.

This module has the command line and the actions `list` and `run`; `faults_fuzz` has the others.
"""

from __future__ import annotations

import argparse
import os
import sys
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from cloudrc.cli.cluster_flags import release_arguments
from cloudrc.cli.extras import require
from cloudrc.cli.output import escape, format_document, output_argument, paint, table
from cloudrc.cli.parser import COUNT_MAX, input_file, read_count
from cloudrc.cli.pool import WorkerDiedError, map_in_order
from cloudrc.errors import BadInputError

if TYPE_CHECKING:
    from cloudrc.faults.document import Result
    from cloudrc.faults.scenario import Mode, Scenario


EPILOG = """\
examples:
  cloudrc faults list                        faults of all three modes
  cloudrc faults run cloud-killed            or by its number: F13
  cloudrc faults run --all --seed 2 --junit faults.xml
  cloudrc faults run --all --real            with processes, signals and sockets
  cloudrc faults fuzz --seeds 200 --jobs 2   random combinations of faults
  cloudrc faults fuzz --seeds 200 --adversarial
  cloudrc faults fuzz --first 201 --seeds 200

exit codes: 0 all checks passed, 1 a check failed, 2 bad input,
  3 or 5 no cluster or no release (--cluster),
  6 a worker was killed, 130 interrupted"""
JOBS = "number of parallel processes, at most one per core (default: 1)"
SEED_MAX = 2**53 - 1 - COUNT_MAX
"""Largest first seed: the seeds counted from it must stay below 2^53."""
ACTIONS = {
    "list": "list all faults with their injection and the expected reaction",
    "run": "inject faults and check the reaction",
    "fuzz": "fly random combinations of faults and check the invariants in every step",
    "replay": "fly a stored schedule of faults again",
}


def arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the command's arguments."""
    actions = parser.add_subparsers(dest="action", metavar="ACTION", title="actions")
    parsers = {}
    for name, text in ACTIONS.items():
        sub = actions.add_parser(name, help=text, description=text[0].upper() + text[1:] + ".")
        parsers[name] = sub
        output_argument(sub)
    _modes(parsers["list"])
    _run_arguments(parsers["run"])
    _fuzz_arguments(parsers["fuzz"])
    parsers["replay"].add_argument(
        "file", type=input_file, metavar="FILE", help="schedule of faults (.yaml)"
    )


def seed(text: str) -> int:
    """Parse a seed for argparse."""
    if not text.isdecimal() or int(text) > SEED_MAX:
        raise argparse.ArgumentTypeError(f"'{text}' is not a whole number from 0 to {SEED_MAX}")
    return int(text)


def output_file(text: str) -> Path:
    """Parse the name of an output file; refuse one that cannot be written."""
    path = Path(text)
    if path.is_dir() or not os.access(path if path.exists() else path.parent, os.W_OK):
        raise argparse.ArgumentTypeError(f"{text}: this file cannot be written")
    return path


def output_folder(text: str) -> Path:
    """Parse the name of an output folder; refuse one that cannot be made."""
    path = Path(text)
    existing = next(each for each in (path, *path.absolute().parents) if each.exists())
    if not (existing.is_dir() and os.access(existing, os.W_OK)):
        raise argparse.ArgumentTypeError(f"{text}: this folder cannot be made")
    return path


def _modes(parser: argparse.ArgumentParser) -> None:
    mode = parser.add_mutually_exclusive_group()
    text = "faults with real processes, signals and sockets on this machine"
    mode.add_argument("--real", action="store_true", help=text)
    text = "faults on a release in a cluster (F38 rotates its key)"
    mode.add_argument("--cluster", action="store_true", help=text)


def _run_arguments(parser: argparse.ArgumentParser) -> None:
    what = parser.add_mutually_exclusive_group(required=True)
    what.add_argument(
        "name", nargs="?", metavar="NAME", help="name of the fault, or its number: F13"
    )
    what.add_argument("--all", action="store_true", help="every fault of the mode")
    _modes(parser)
    parser.add_argument("--seed", type=seed, default=1, metavar="N", help="seed (default: 1)")
    parser.add_argument("--jobs", type=read_count, default=1, metavar="J", help=JOBS)
    parser.add_argument(
        "--junit", type=output_file, metavar="FILE", help="write the results as JUnit XML"
    )
    text = "write the results as a Markdown page (needs --all)"
    parser.add_argument("--document", type=output_file, metavar="FILE", help=text)
    release_arguments(parser)


def _fuzz_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "--seeds", type=read_count, default=200, metavar="N", help="number of seeds (default: 200)"
    )
    parser.add_argument(
        "--first", type=seed, default=1, metavar="N", help="first seed (default: 1)"
    )
    parser.add_argument("--jobs", type=read_count, default=1, metavar="J", help=JOBS)
    kind = parser.add_mutually_exclusive_group()
    kind.add_argument(
        "--adversarial",
        action="store_true",
        help="the cloud has valid keys and tries to break the invariants",
    )
    kind.add_argument(
        "--clean", action="store_true", help="inject no faults: any HOLD is a false alarm"
    )
    text = "write the results as a Markdown page"
    parser.add_argument("--document", type=output_file, metavar="FILE", help=text)
    parser.add_argument(
        "--store",
        type=output_folder,
        default=Path("faults-found"),
        metavar="DIR",
        help="folder for failing schedules, after reduction (default: ./faults-found)",
    )


def execute(options: argparse.Namespace) -> int:
    """Run the chosen action."""
    if options.action is None:
        names = ", ".join(ACTIONS)
        raise BadInputError(f"an action is missing: {names}; see 'cloudrc faults --help'")
    require("the fault suite", ("world", "record"))
    from cloudrc.cli import faults_fuzz

    actions = {
        "list": print_faults,
        "run": run,
        "fuzz": faults_fuzz.fuzz,
        "replay": faults_fuzz.replay,
    }
    return actions[options.action](options)


COLOURS = {"passed": "green", "FAILED": "red", "skipped": "yellow"}
FAILED, INTERRUPTED = 1, 130
PLACE = ("context", "namespace", "release")
"""Options that select a release in a cluster."""


def print_faults(options: argparse.Namespace) -> int:
    """Print the list of faults."""
    from cloudrc.faults.scenario import scenarios

    found = scenarios(_mode(options) if options.real or options.cluster else None)
    if options.output != "table":
        names = ("id", "name", "mode", "injects", "expects", "loses", "shows")
        faults = [{n: getattr(each, n) for n in names} for each in found]
        print(format_document({"schemaVersion": 1, "faults": faults}, options.output))
        return 0
    rows = [("fault", "name", "mode", "injection", "expected reaction")]
    rows += [(each.id, each.name, each.mode, each.injects, each.expects) for each in found]
    print(table(rows))
    return 0


def run(options: argparse.Namespace) -> int:
    """Run one fault or all; return 1 if a check failed, 130 if interrupted."""
    from cloudrc.faults import document
    from cloudrc.faults.scenario import called, scenarios

    mode = _mode(options)
    if options.document is not None and not options.all:
        raise BadInputError("--document writes a page of all faults: give --all instead of a name")
    if mode == "cluster":
        _look_for_release(options)
    elif any(_place(options).values()):
        flags = ", ".join(f"--{name}" for name in PLACE)
        raise BadInputError(f"{flags} select a release in a cluster: add --cluster")
    chosen = scenarios(mode) if options.all else called(options.name, mode)
    say = print if options.output == "table" else _silent
    results, cause, code = [], "", 0
    try:
        for result in _results(chosen, options):
            results.append(result)
            _print_result(result, options.all, say)
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
        print(format_document(document.as_json(results, options.seed), options.output))
    failed = sum(result.failed for result in results)
    passed = sum(result.passed for result in results)
    say(f"\nseed {options.seed}: {passed} of {len(results)} passed, {failed} failed")
    if cause:
        message = f"cloudrc: {cause}; {len(results)} of {len(chosen)} faults were run before"
        print(message, file=sys.stderr, flush=True)
    return code or (FAILED if failed else 0)


def _look_for_release(options: argparse.Namespace) -> None:
    """Report a missing cluster or release once, not with every fault."""
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
    return map_in_order(_run, names, jobs)


def _run(job: tuple[str, Mode, int]) -> Result:
    """Run one fault, in this process or in a worker; an exception becomes a failed result."""
    from cloudrc.faults.document import Result
    from cloudrc.faults.scenario import Outcome, find

    name, mode, seed = job
    scenario, began = find(name, mode), time.monotonic()
    try:
        return Result(scenario, scenario.run(seed), time.monotonic() - began)
    except Exception as error:  # this scenario fails, the others still run
        text = f"{type(error).__name__}: {error}"
        return Result(scenario, Outcome(), time.monotonic() - began, text)


def _print_result(result: Result, briefly: bool, say: Callable[[str], object]) -> None:
    scenario, outcome = result.scenario, result.outcome
    word = paint(result.word, COLOURS[result.word])
    sha = f"  {outcome.sha256[:12]}" if outcome.sha256 else ""
    say(f"{word:8} {scenario.id:4} {scenario.name:26} {result.seconds:6.1f} s{sha}")
    for reason in filter(None, (result.error, outcome.skipped)):
        say(f"           {escape(reason)}")
    shown: Iterable[str] = (
        f"         {'' if check.passed else 'x '}{escape(check.show())}"
        for check in outcome.checks
        if not (briefly and check.passed)
    )
    for line in shown:
        say(line)


def _silent(text: str) -> None:
    """Print nothing: stdout is for the document alone."""
