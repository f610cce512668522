"""Run `cloudrc faults`: inject faults and check how the system reacts."""

from __future__ import annotations

import argparse
import os
import sys
import time
from collections.abc import Callable
from contextlib import closing
from pathlib import Path
from typing import TYPE_CHECKING

from cloudrc.cli.extras import require
from cloudrc.cli.output import escape, format_document, output_argument, paint, print_line, table
from cloudrc.cli.parser import COUNT_MAX, input_file, read_count
from cloudrc.cli.pool import WorkerDiedError, interrupt_on_signals, map_in_order
from cloudrc.errors import BadInputError

if TYPE_CHECKING:
    from cloudrc.faults.report import Result
    from cloudrc.faults.search import Search

EPILOG = """\
examples:
  cloudrc faults list
  cloudrc faults run cloud-killed            or by its number: F13
  cloudrc faults run --all --seed 2 --junit faults.xml
  cloudrc faults search --minutes 10         random combinations of faults
  cloudrc faults search --minutes 5 --adversarial
  cloudrc faults search --first 201          continue an earlier search
  cloudrc faults run faults-found/stuck-seed-12.yaml

exit codes: 0 all checks passed, 1 a check failed, 2 bad input,
  6 a worker was killed, 130 interrupted"""
JOBS = "number of parallel processes, at most one per core (default: 1)"
SEED_MAX = 2**53 - 1 - COUNT_MAX
"""Largest first seed: the seeds counted from it must stay below 2^53."""
MINUTES_MAX = 10_000.0
"""Longest search [min]: a week."""
ACTIONS = {
    "list": "list all faults with their injection and the expected reaction",
    "run": "inject faults, or those of a schedule's file, and check the reaction",
    "search": "fly random combinations of faults and check the invariants in every step",
}
FAILED, INTERRUPTED = 1, 130


def arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the command's arguments."""
    actions = parser.add_subparsers(dest="action", metavar="ACTION", title="actions")
    parsers = {}
    for name, text in ACTIONS.items():
        parsers[name] = actions.add_parser(
            name, help=text, description=text[0].upper() + text[1:] + "."
        )
        output_argument(parsers[name])
    _run_arguments(parsers["run"])
    _search_arguments(parsers["search"])


def _run_arguments(parser: argparse.ArgumentParser) -> None:
    what = parser.add_mutually_exclusive_group(required=True)
    what.add_argument(
        "name",
        nargs="?",
        type=_name_or_file,
        metavar="NAME",
        help="name of the fault, its number: F13, or a schedule's file (.yaml)",
    )
    what.add_argument("--all", action="store_true", help="every fault")
    parser.add_argument("--seed", type=read_seed, default=1, metavar="N", help="seed (default: 1)")
    parser.add_argument("--jobs", type=read_count, default=1, metavar="J", help=JOBS)
    parser.add_argument(
        "--junit", type=_output_file, metavar="FILE", help="write the results as JUnit XML"
    )


def _search_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "--minutes", type=_minutes, default=1.0, metavar="M", help="duration (default: 1)"
    )
    parser.add_argument(
        "--first", type=read_seed, default=1, metavar="SEED", help="first seed (default: 1)"
    )
    parser.add_argument(
        "--adversarial",
        action="store_true",
        help="the cloud has valid keys and tries to break the invariants",
    )
    parser.add_argument("--jobs", type=read_count, default=1, metavar="J", help=JOBS)
    parser.add_argument(
        "--store",
        type=_output_folder,
        default=Path("faults-found"),
        metavar="DIR",
        help="folder for failing schedules, after reduction (default: ./faults-found)",
    )


def read_seed(text: str) -> int:
    """Parse a seed for argparse."""
    if not text.isdecimal() or int(text) > SEED_MAX:
        raise argparse.ArgumentTypeError(f"'{text}' is not a whole number from 0 to {SEED_MAX}")
    return int(text)


def _minutes(text: str) -> float:
    try:
        minutes = float(text)
    except ValueError:
        minutes = -1.0
    if not 0.0 < minutes <= MINUTES_MAX:  # or it is NaN
        raise argparse.ArgumentTypeError(f"'{text}' is not a number of minutes, such as 10")
    return minutes


def _name_or_file(text: str) -> str | Path:
    """Parse the name of a fault, or the path of a schedule's file."""
    return input_file(text) if os.path.exists(text) or text.endswith((".yaml", ".yml")) else text


def _output_file(text: str) -> Path:
    """Parse the name of an output file; refuse one that cannot be written."""
    path = Path(text)
    if path.is_dir() or not os.access(path if path.exists() else path.parent, os.W_OK):
        raise argparse.ArgumentTypeError(f"{text}: this file cannot be written")
    return path


def _output_folder(text: str) -> Path:
    """Parse the name of an output folder; refuse one that cannot be made."""
    path = Path(text)
    existing = next(each for each in (path, *path.absolute().parents) if each.exists())
    if not (existing.is_dir() and os.access(existing, os.W_OK)):
        raise argparse.ArgumentTypeError(f"{text}: this folder cannot be made")
    return path


def execute(options: argparse.Namespace) -> int:
    """Run the chosen action."""
    if options.action is None:
        names = ", ".join(ACTIONS)
        raise BadInputError(f"an action is missing: {names}; see 'cloudrc faults --help'")
    require("the fault suite", ("world", "record"))
    interrupt_on_signals()
    if options.action == "run":
        return fly_file(options) if isinstance(options.name, Path) else run(options)
    return {"list": print_faults, "search": search}[options.action](options)


def print_faults(options: argparse.Namespace) -> int:
    """Print the list of faults."""
    from cloudrc.faults.scenarios import SCENARIOS

    if options.output != "table":
        names = ("id", "name", "injects", "expects", "loses", "shows")
        faults = [{n: getattr(each, n) for n in names} for each in SCENARIOS]
        print(format_document({"schemaVersion": 1, "faults": faults}, options.output))
        return 0
    rows = [("fault", "name", "injection", "expected reaction")]
    rows += [(each.id, each.name, each.injects, each.expects) for each in SCENARIOS]
    print(table(rows))
    return 0


def run(options: argparse.Namespace) -> int:
    """Run one fault or all; return 1 if a check failed, 130 if interrupted."""
    from cloudrc.faults import report
    from cloudrc.faults.scenarios import SCENARIOS, find

    chosen = SCENARIOS if options.all else (find(options.name),)
    say = print if options.output == "table" else _silent
    results, cause, code = [], "", 0
    try:
        jobs = [(each.name, options.seed) for each in chosen]
        for result in map_in_order(_run, jobs, options.jobs):
            results.append(result)
            _print_result(result, options.all, say)
    except KeyboardInterrupt:
        cause, code = "interrupted", INTERRUPTED
    except WorkerDiedError as error:
        cause, code = str(error), error.exit_code
    if options.junit is not None:
        options.junit.write_text(report.as_junit(results, options.seed), encoding="utf-8")
    if options.output != "table":
        print(format_document(report.as_json(results, options.seed), options.output))
    passed = sum(result.passed for result in results)
    failed = len(results) - passed
    say(f"\nseed {options.seed}: {passed} of {len(results)} passed, {failed} failed")
    if cause:
        message = f"cloudrc: {cause}; {len(results)} of {len(chosen)} faults were run before"
        print(message, file=sys.stderr, flush=True)
    return code or (FAILED if failed else 0)


def _run(job: tuple[str, int]) -> Result:
    """Run one fault, in this process or in a worker; an exception becomes a failed result."""
    from cloudrc.faults.report import Result
    from cloudrc.faults.scenario import Outcome
    from cloudrc.faults.scenarios import find

    name, seed = job
    scenario, began = find(name), time.monotonic()
    try:
        return Result(scenario, scenario.run(seed), time.monotonic() - began)
    except Exception as error:  # this scenario fails, the others still run
        text = f"{type(error).__name__}: {error}"
        return Result(scenario, Outcome(), time.monotonic() - began, text)


def _print_result(result: Result, briefly: bool, say: Callable[[str], object]) -> None:
    scenario, outcome = result.scenario, result.outcome
    word = paint(result.word, "green" if result.passed else "red")
    sha = f"  {outcome.sha256[:12]}" if outcome.sha256 else ""
    say(f"{word:8} {scenario.id:4} {scenario.name:26} {result.seconds:6.1f} s{sha}")
    if result.error:
        say(f"           {escape(result.error)}")
    for check in outcome.checks:
        if not (briefly and check.passed):
            say(f"         {'' if check.passed else 'x '}{escape(check.show())}")


def fly_file(options: argparse.Namespace) -> int:
    """Fly the schedule of a file; return 1 if an invariant breaks."""
    from cloudrc.faults.schedule import load
    from cloudrc.faults.trial import fly

    if options.junit is not None or options.seed != 1:
        raise BadInputError("--junit and --seed belong to named faults, not to a schedule's file")
    try:
        finding = fly(load(options.name), keep=True)
    except BadInputError as error:  # an unknown profile or policy
        where = "" if str(options.name) in str(error) else f"{options.name}: "
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


def search(options: argparse.Namespace) -> int:
    """Search for some minutes; return 1 if an invariant broke, 130 if interrupted."""
    from cloudrc.faults import report
    from cloudrc.faults.search import Search

    kind = "adversarial" if options.adversarial else "random"
    searched = Search(kind, options.first, options.store)
    say = print_line if options.output == "table" else _silent
    say(f"{kind} schedules from seed {options.first} on, for {options.minutes:g} min")
    cause, code = "", 0
    try:
        _search(searched, options, say)
    except KeyboardInterrupt:
        cause, code = "interrupted", INTERRUPTED
    except WorkerDiedError as error:
        cause, code = str(error), error.exit_code
    document = searched.document()
    if options.output != "table":
        print(format_document(document, options.output))
    else:
        print("\n" + table(report.search_rows(document), right=(1, 2)))
        print(f"\n{report.search_summary(document)}")
    flags = f"{' --adversarial' if options.adversarial else ''} --first {searched.next}"
    say(f"to continue: cloudrc faults search{flags}")
    if cause:
        message = f"cloudrc: {cause}; continue with 'cloudrc faults search{flags}'"
        print(message, file=sys.stderr, flush=True)
    return code or (FAILED if searched.failures else 0)


def _search(searched: Search, options: argparse.Namespace, say: Callable[[str], object]) -> None:
    with closing(searched.run(options.minutes, map_in_order, options.jobs)) as flights:
        for failure in flights:
            if failure is not None:
                say(f"FAILED seed {failure['seed']}: {failure['breaches'][0]['text']}")
                say(f"  again: cloudrc faults run {failure['file']}")


def _silent(text: str) -> None:
    """Print nothing: stdout is for the document alone."""
