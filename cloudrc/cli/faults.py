# SPDX-License-Identifier: Apache-2.0

"""Run `cloudrc faults`: inject faults and check how the system reacts."""

from __future__ import annotations

import os
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from cloudrc.cli.output import output_argument, paint, print_line, print_result, tell
from cloudrc.cli.parser import Options, Parser, add_verbs, flags, number, read_count, whole_number
from cloudrc.errors import BadInputError
from cloudrc.outside.refusal import check_names
from cloudrc.text import table
from cloudrc.trials.workers import map_in_order, take_each

if TYPE_CHECKING:
    from cloudrc.faults.measures import Outcome
    from cloudrc.faults.trial import TrialResult

EPILOG = """\
examples:
  cloudrc faults list
  cloudrc faults run cloud-killed            or by its number: F13
  cloudrc faults run --all --seed 2 -o json
  cloudrc faults search --minutes 10         random combinations of faults
  cloudrc faults search --minutes 5 --adversarial --robot rover
  cloudrc faults search --first 201          continue an earlier search
  cloudrc faults run faults-found/stuck-seed-12.yaml

exit codes: 0 all checks passed, 1 a check failed, 2 bad input,
  6 a worker was killed, 130 interrupted"""
SEED_MAX = 2**52
"""Largest value of --seed and --first. A search counts up from --first, and seeds end at 2^53."""
MINUTES_MAX = 10_000
"""Longest duration of a search [min]: about a week."""
VERBS = {
    "list": "list all faults with their injection and the expected reaction",
    "run": "inject faults, or those of a schedule's file, and check the reaction",
    "search": "fly random combinations of faults and check the invariants in every step",
}
STORE = Path("faults-found")
FAILED = 1


def arguments(parser: Parser) -> None:
    """Declare the command's arguments."""
    parsers = add_verbs(parser, VERBS)
    for verb in parsers.values():
        output_argument(verb)
    what = flags(parsers["run"].add_mutually_exclusive_group(required=True))
    text = "name of the fault, its number: F13, or a schedule's file (.yaml)"
    what("name", "NAME", text, read=_name_or_file, nargs="?")
    what("--all", "", "every fault")
    add, seed = flags(parsers["run"]), whole_number(0, SEED_MAX)
    add("--seed", "N", "seed (default: 1)", 1, seed)
    about = "number of parallel processes, at most one per core (default: 1)"
    add("--jobs", "J", about, 1, read_count)
    add = flags(parsers["search"])
    add("--minutes", "M", "duration (default: 1)", 1.0, number(0, MINUTES_MAX, "minutes"))
    add("--first", "SEED", "first seed (default: 1)", 1, seed)
    add("--jobs", "J", about, 1, read_count)
    add("--store", "DIR", f"folder for failing schedules (default: ./{STORE})", STORE)
    add("--adversarial", "", "the cloud has valid keys and tries to break the invariants")
    about = "name of a shipped robot, or path of a robot (default: that of every experiment)"
    add("--robot", "NAME", about)


def _name_or_file(text: str) -> str | Path:
    is_path = "/" in text or text.endswith((".yaml", ".yml")) or os.path.isfile(text)
    return Path(text) if is_path else text


def execute(options: Options) -> int | None:
    """Run the chosen verb; return 1 if a check failed, 130 after an interrupt signal."""
    return {"list": print_faults, "run": run, "search": search}[options.verb](options)


def print_faults(options: Options) -> None:
    """Print each fault: how it is injected, and the expected reaction of the system."""
    from cloudrc.faults.scenarios import SCENARIOS

    names = ("id", "name", "injects", "expects")
    faults = [{name: getattr(each, name) for name in names} for each in SCENARIOS.values()]
    head = "fault", "name", "injection", "expected reaction"
    text = table([head, *(tuple(each.values()) for each in faults)])
    print_result(options.output, {"faults": faults}, text)


def run(options: Options) -> int:
    """Run one fault, all faults, or the schedule of faults in a file; return the exit code."""
    from cloudrc.cli.progress import Progress
    from cloudrc.faults.scenarios import SCENARIOS
    from cloudrc.faults.search import run_fault

    if isinstance(options.name, Path):
        return run_file(options)
    names = {each.id.lower(): each.name for each in SCENARIOS.values()}
    name = str(options.name).lower()
    chosen = [*SCENARIOS] if options.all else [names.get(name, name)]
    check_names("fault", chosen, SCENARIOS)
    faults: list[dict[str, Any]] = []

    def take(outcome: Outcome) -> None:
        scenario = SCENARIOS[chosen[len(faults)]]
        faults.append(scenario.as_json(outcome))
        if options.output == "table":
            print("\n".join(scenario.as_lines(outcome, paint, briefly=options.all)))

    run_seed = partial(run_fault, seed=options.seed)
    flown = map_in_order(run_seed, chosen, options.jobs)
    with Progress("flies with the faults"):
        stopped = take_each(flown, take)
    done, failed = len(faults), sum(each["result"] == "failed" for each in faults)
    document = {"seed": options.seed, "passed": not failed, "faults": faults}
    text = f"\nseed {options.seed}: {done - failed} of {done} passed, {failed} failed"
    print_result(options.output, document, text)
    if stopped:
        tell(f"{stopped}; {done} of {len(chosen)} faults were run before")
        return stopped.exit_code
    return FAILED if failed else 0


def run_file(options: Options) -> int:
    """Fly the schedule of faults in a file; return 1 if the flight breaks a safety invariant."""
    from cloudrc.cli.progress import Progress
    from cloudrc.faults.schedule import load
    from cloudrc.faults.trial import fly

    if options.seed != 1:
        raise BadInputError("--seed belongs to named faults, not to a schedule's file")
    with Progress(f"flies {options.name}"):
        try:
            finding = fly(load(options.name), hashed=True)
        except ValueError as error:
            raise BadInputError(f"{options.name}: {error}") from error
    breaches = [breach._asdict() for breach in finding.breaches]
    document = {"records_sha256": finding.sha256, "breaches": breaches}
    print_result(options.output, document, finding.as_text())
    return FAILED if breaches else 0


def search(options: Options) -> int:
    """Fly random schedules of faults; print the failures, and how to continue the search."""
    from cloudrc.cli.progress import Progress
    from cloudrc.config import shipped
    from cloudrc.config.schema import World
    from cloudrc.faults.search import fly_seed, search, search_rows, search_summary, store

    options.store.mkdir(parents=True, exist_ok=True)
    robot = shipped.model_path("robot", options.robot or World().robot, Path())
    kind = "adversarial" if options.adversarial else "random"
    shown = options.output == "table"
    if shown:
        about = f"{kind} schedules of {robot} from seed {options.first} on"
        print_line(f"{about}, for {options.minutes:g} min")

    def see(finding: TrialResult) -> dict[str, Any]:
        failure = store(finding, options.store)
        if shown:
            print_line(f"FAILED seed {failure['seed']}: {failure['breaches'][0]['text']}")
            print_line(f"  again: cloudrc faults run {failure['file']}")
        return failure

    fly = partial(fly_seed, adversarial=options.adversarial, robot=robot)
    with Progress("flies schedules"):
        found, stopped = search(fly, options.first, options.minutes, options.jobs, see)
    found = {"kind": kind, "robot": robot} | found
    again = f"to continue, add --first {found['next']}"
    lines = "", table(search_rows(found), right=(1, 2)), "", search_summary(found), again
    print_result(options.output, found, "\n".join(lines))
    if stopped:
        tell(f"{stopped}; {again}")
        return stopped.exit_code
    return FAILED if found["failures"] else 0
