"""Run `cloudrc faults`: inject faults and check how the system reacts."""

from __future__ import annotations

import argparse
import os
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

from cloudrc.cli.extras import require
from cloudrc.cli.output import escape, format_document, output_argument, paint, print_line, table
from cloudrc.cli.parser import input_file, number, read_count, whole_number
from cloudrc.cli.pool import interrupt_on_signals, map_in_order, take_each
from cloudrc.errors import BadInputError

if TYPE_CHECKING:
    from cloudrc.faults.measures import Outcome, Scenario

EPILOG = """\
examples:
  cloudrc faults list
  cloudrc faults run cloud-killed            or by its number: F13
  cloudrc faults run --all --seed 2 -o json
  cloudrc faults search --minutes 10         random combinations of faults
  cloudrc faults search --minutes 5 --adversarial
  cloudrc faults search --first 201          continue an earlier search
  cloudrc faults run faults-found/stuck-seed-12.yaml

exit codes: 0 all checks passed, 1 a check failed, 2 bad input,
  6 a worker was killed, 130 interrupted"""
SEED_MAX = 2**52
"""Largest value of --seed and --first. A search counts up from --first, and seeds end at 2^53."""
MINUTES_MAX = 10_000
"""Longest duration of a search [min]: about a week."""
ACTIONS = {
    "list": "list all faults with their injection and the expected reaction",
    "run": "inject faults, or those of a schedule's file, and check the reaction",
    "search": "fly random combinations of faults and check the invariants in every step",
}
STORE = Path("faults-found")
FAILED = 1


def arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the command's arguments."""
    actions = parser.add_subparsers(dest="action", required=True, metavar="ACTION", title="actions")
    parsers = {}
    for name, text in ACTIONS.items():
        description = f"{text[0].upper()}{text[1:]}."
        parsers[name] = actions.add_parser(name, help=text, description=description)
        output_argument(parsers[name])
    what = parsers["run"].add_mutually_exclusive_group(required=True)
    text = "name of the fault, its number: F13, or a schedule's file (.yaml)"
    what.add_argument("name", nargs="?", type=_name_or_file, metavar="NAME", help=text)
    what.add_argument("--all", action="store_true", help="every fault")
    for name, options in OPTIONS.items():
        for option, (read, default, metavar, text) in options.items():
            parsers[name].add_argument(
                option, type=read, default=default, metavar=metavar, help=text
            )
    text = "the cloud has valid keys and tries to break the invariants"
    parsers["search"].add_argument("--adversarial", action="store_true", help=text)


def _name_or_file(text: str) -> str | Path:
    is_path = "/" in text or text.endswith((".yaml", ".yml")) or os.path.isfile(text)
    return input_file(text) if is_path else text


def _folder(text: str) -> Path:
    path = Path(text)
    existing = next(each for each in (path, *path.absolute().parents) if each.exists())
    if not (existing.is_dir() and os.access(existing, os.W_OK)):
        raise argparse.ArgumentTypeError(f"{text}: cannot be written")
    return path


JOBS = (read_count, 1, "J", "number of parallel processes, at most one per core (default: 1)")
STORED = f"folder for failing schedules (default: ./{STORE})"
OPTIONS: dict[str, dict[str, tuple[Callable[[str], Any], Any, str, str]]] = {
    "run": {"--seed": (whole_number(0, SEED_MAX), 1, "N", "seed (default: 1)"), "--jobs": JOBS},
    "search": {
        "--minutes": (number(0, MINUTES_MAX, "minutes"), 1.0, "M", "duration (default: 1)"),
        "--first": (whole_number(0, SEED_MAX), 1, "SEED", "first seed (default: 1)"),
        "--jobs": JOBS,
        "--store": (_folder, STORE, "DIR", STORED),
    },
}
"""Action -> option -> function that parses the value, default, metavar, help text."""


def execute(options: argparse.Namespace) -> int:
    """Run the chosen action; return 1 if a check failed, 130 after an interrupt signal."""
    require("the fault suite", ("world", "record"))
    interrupt_on_signals()
    return {"list": print_faults, "run": run, "search": search}[options.action](options)


def print_faults(options: argparse.Namespace) -> int:
    """Print each fault: how it is injected, and the expected reaction of the system."""
    from cloudrc.faults.scenarios import SCENARIOS

    names = ("id", "name", "injects", "expects")
    faults = [{name: getattr(each, name) for name in names} for each in SCENARIOS]
    if options.output != "table":
        print(format_document({"schemaVersion": 1, "faults": faults}, options.output))
    else:
        rows = [tuple(each.values()) for each in faults]
        print(table([("fault", "name", "injection", "expected reaction"), *rows]))
    return 0


def run(options: argparse.Namespace) -> int:
    """Run one fault, all faults, or the schedule of faults in a file; return the exit code."""
    from cloudrc.faults.scenarios import SCENARIOS, find

    if isinstance(options.name, Path):
        return fly_file(options)
    chosen = SCENARIOS if options.all else (find(options.name),)
    outcomes: list[Outcome] = []

    def take(outcome: Outcome) -> None:
        outcomes.append(outcome)
        if options.output == "table":
            _print_outcome(chosen[len(outcomes) - 1], outcome, options.all)

    jobs = [(each.name, options.seed) for each in chosen]
    cause, code = take_each(map_in_order(_run, jobs, options.jobs), take)
    count, failed = len(outcomes), sum(not outcome.passed for outcome in outcomes)
    if options.output != "table":
        faults = [each.as_json(done) for each, done in zip(chosen, outcomes, strict=False)]
        document = {"schemaVersion": 1, "seed": options.seed, "passed": not failed}
        print(format_document(document | {"faults": faults}, options.output))
    else:
        print(f"\nseed {options.seed}: {count - failed} of {count} passed, {failed} failed")
    if cause:
        text = f"cloudrc: {cause}; {count} of {len(chosen)} faults were run before"
        print(text, file=sys.stderr, flush=True)
    return code or (FAILED if failed else 0)


def _run(job: tuple[str, int]) -> Outcome:
    from cloudrc.faults.scenarios import find

    (name, seed), began = job, time.monotonic()
    outcome = find(name).run(seed)
    outcome.seconds = time.monotonic() - began
    return outcome


def _print_outcome(scenario: Scenario, outcome: Outcome, briefly: bool) -> None:
    word = paint(outcome.word, "green" if outcome.passed else "red")
    sha = f"  {outcome.sha256[:12]}" if outcome.sha256 else ""
    print(f"{word:8} {scenario.id:4} {scenario.name:26} {outcome.seconds:6.1f} s{sha}")
    if outcome.error:
        print(f"           {escape(outcome.error)}")
    for check in outcome.checks:
        if not (briefly and check.passed):
            print(f"         {'' if check.passed else 'x '}{escape(check.show())}")


def fly_file(options: argparse.Namespace) -> int:
    """Fly the schedule of faults in a file; return 1 if the flight breaks a safety invariant."""
    from cloudrc.faults.schedule import load
    from cloudrc.faults.trial import fly

    if options.seed != 1:
        raise BadInputError("--seed belongs to named faults, not to a schedule's file")
    schedule = load(options.name)
    try:
        finding = fly(schedule, keep=True)
    except BadInputError as error:  # an unknown profile or policy
        raise BadInputError(f"{options.name}: {error}") from error
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
    """Fly random schedules of faults; print the failures, and how to continue the search."""
    from cloudrc.faults.search import Search, search_rows, search_summary

    kind, shown = "adversarial" if options.adversarial else "random", options.output == "table"
    searched = Search(kind, options.first, options.store)
    document = searched.document

    def take(failure: dict[str, Any] | None) -> None:
        if failure is not None and shown:
            print_line(f"FAILED seed {failure['seed']}: {failure['breaches'][0]['text']}")
            print_line(f"  again: cloudrc faults run {failure['file']}")

    if shown:
        print(f"{kind} schedules from seed {options.first} on, for {options.minutes:g} min")
    flights = searched.run(options.minutes, map_in_order, options.jobs)
    cause, code = take_each(flights, take)
    again = f"cloudrc faults search{' --adversarial' if options.adversarial else ''}"
    again += f" --first {document['next']}"
    if shown:
        print(f"\n{table(search_rows(document), right=(1, 2))}\n\n{search_summary(document)}")
        print(f"to continue: {again}")
    else:
        print(format_document(document, options.output))
    if cause:
        print(f"cloudrc: {cause}; continue with '{again}'", file=sys.stderr, flush=True)
    return code or (FAILED if document["failures"] else 0)
