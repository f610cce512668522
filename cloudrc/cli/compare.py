"""`cloudrc compare A B`: say whether B differs from A, by how much, and how sure that is."""

from __future__ import annotations

import argparse
import re
import sys
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from cloudrc.cli.extras import MODES, require
from cloudrc.cli.output import (
    format_document,
    format_number,
    is_live,
    output_argument,
    print_or_drop,
    table,
)
from cloudrc.cli.parser import read_count
from cloudrc.cli.pool import interrupt_on_signals, map_in_order, take_each
from cloudrc.errors import BadInputError

if TYPE_CHECKING:
    from cloudrc.sweep.compare import Pair
    from cloudrc.sweep.flight import Outcome

Job = tuple[str, Sequence[str], int]
"""A flight: name of the experiment, overrides, seed."""
EPILOG = """\
A and B are one of:
  settings           KEY=VALUE[,KEY=VALUE...]: fly both with each seed
  values of an axis  of the finished sweep in --in DIR
  folders            of 'cloudrc run' or 'cloudrc run --seeds N'

examples:
  cloudrc compare cloud.predictor=constant_velocity \\
    cloud.predictor=constant_acceleration --set link.profile=paper-p3
  cloudrc compare cloud.predictor=last_sample \\
    cloud.predictor=constant_velocity,cloud.estimator=split --number rtt_mean
  cloudrc compare paper-p1 paper-p3 --in runs/sweep-steps-1
  cloudrc compare runs/steps-virtual-10seeds-1 runs/steps-virtual-10seeds-2

docs/compare.md explains intervals, p and the number of pairs needed."""


def arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the command's arguments."""
    add = parser.add_argument
    add("a", metavar="A", help="the setting to compare with")
    add("b", metavar="B", help="the setting to judge")
    about = "experiment to fly: a shipped name or a YAML file (default: steps)"
    add("--of", default="steps", dest="experiment", metavar="EXPERIMENT", help=about)
    about = "change one key for both sides; repeatable"
    add("--set", action="append", default=[], metavar="KEY=VALUE", help=about)
    about = "fly seeds 1 to N on both sides (default: 10)"
    add("--seeds", type=read_count, default=10, metavar="N", help=about)
    add("--in", type=Path, dest="sweep", metavar="DIR", help="compare flights of this sweep")
    about = "compare this metric instead of the default ones; repeatable"
    add("--number", action="append", default=[], metavar="NAME", help=about)
    output_argument(parser)


def execute(options: argparse.Namespace) -> int:
    """Compare and print; return 0 whatever the answer, or 130 if flights were interrupted."""
    from cloudrc.sweep import pairs
    from cloudrc.sweep.compare import compare

    code, stopped = 0, ""
    facts: dict[str, Any] = {"a": options.a, "b": options.b}
    if options.sweep:
        found, where = pairs.of_sweep(options.sweep, options.a, options.b)
        facts |= {"sweep": str(options.sweep), "key": where}
    elif Path(options.a).is_dir() and Path(options.b).is_dir():
        found, keys = pairs.of_folders(Path(options.a), Path(options.b))
        facts["differing_keys"] = keys
    else:
        facts |= {"experiment": options.experiment, "overrides": options.set}
        found, stopped, code = _fly_both(options)
    document = {
        **{"schemaVersion": 1, **facts, "interrupted": bool(stopped)},
        **compare(found, options.number),
    }
    if stopped:
        print_or_drop(f"cloudrc: {stopped}: {len(found)} pairs are finished", sys.stderr)
    shown = options.output == "table"
    print_or_drop(as_text(document) if shown else format_document(document, options.output))
    return code


def _fly_both(options: argparse.Namespace) -> tuple[list[Pair], str, int]:
    """Fly A and B with each seed; return the pairs, and why and with which code it ended early."""
    from cloudrc.cli.advice import warn
    from cloudrc.cli.run import load
    from cloudrc.sweep.compare import Pair

    interrupt_on_signals()
    require("compare", MODES["virtual"])
    # A comma separates settings only before KEY=: a list may contain commas.
    sides = [re.split(r",(?=[\w.]+=)", text) for text in (options.a, options.b)]
    keys = {text.partition("=")[0].strip() for side in sides for text in side}
    common = [text for text in options.set if text.partition("=")[0].strip() not in keys]
    if len(common) < len(options.set):
        twice = next(text for text in options.set if text not in common)
        raise BadInputError(f"--set {twice}: is set by A or B, too; keep one of them")
    overrides = [[*common, *side] for side in sides]
    resolved = [load(options.experiment, texts) for texts in overrides]
    if resolved[0] == resolved[1]:
        raise BadInputError("A and B are the same experiment; change one of them")
    for experiment in resolved:
        warn(experiment)
    jobs = [(options.experiment, texts, seed + 1) for seed in range(options.seeds)
            for texts in overrides]  # fmt: skip
    flights: list[Outcome] = []
    stopped, code = take_each(map_in_order(fly_job, jobs, len(jobs)), collect(flights, len(jobs)))
    both = zip(flights[::2], flights[1::2], strict=False)
    return [Pair({"seed": n}, a, b) for n, (a, b) in enumerate(both, start=1)], stopped, code


def collect(flights: list[Outcome], count: int) -> Callable[[Outcome], None]:
    """Return a function that appends a flight and, on a terminal, shows how many are done."""

    def take(flight: Outcome) -> None:
        flights.append(flight)
        if is_live(sys.stderr):
            end = "\r" if len(flights) < count else "\r\x1b[K"
            print(f"  {len(flights)} of {count} flights", end=end, file=sys.stderr, flush=True)

    return take


def fly_job(job: Job) -> Outcome:
    """Fly one job in virtual time, without files."""
    from cloudrc.cli.run import load
    from cloudrc.sweep.flight import fly_point

    return fly_point(load(*job))


def as_text(document: Mapping[str, Any]) -> str:
    """Format the result of a comparison as a table and one sentence that answers."""
    titles = ("number", "A median", "B median", "B - A", "95 % interval", "B lower in", "p",
              "decided", "unit")  # fmt: skip
    body = [_row(name, entry) for name, entry in document["numbers"].items()]
    success = document["success"]
    rates = [
        f"success {side.upper()}: {success[side]} of {success['count']} "
        f"(95 % interval {low:.0%} .. {high:.0%})"
        for side, (low, high) in (("a", success["a_interval"]), ("b", success["b_interval"]))
    ]
    sides = [f"{key}: {document[key.lower()]}" for key in "AB"]
    notes = [f"p (McNemar): {success['p_mcnemar']:.2g}", "", document["method"]]
    if document["left_out"]:
        notes.insert(1, f"{document['left_out']} pairs are left out: a flight did not end")
    if "differing_keys" in document:
        sides.append(f"differing keys: {', '.join(document['differing_keys'])}")
    lines = [*sides, "", table([titles, *body], right=(1, 2, 3)), "", *rates, *notes]
    return "\n".join([*lines, "", answer(document)])


def _row(name: str, entry: Mapping[str, Any]) -> tuple[str, ...]:
    factor, unit = _scale(entry)
    values = [entry[key] * factor for key in ("a_median", "b_median", "difference")]
    between = " .. ".join(format_number(bound * factor) for bound in entry["interval"] or ())
    return (
        *(name, *map(format_number, values), between or "-"),
        *(f"{entry['lower']} of {entry['count']}", f"{entry['p_wilcoxon']:.2g}"),
        *("yes" if entry["decided"] else f"no: {_needed(entry)}", unit),
    )


def _scale(entry: Mapping[str, Any]) -> tuple[float, str]:
    """Return the factor and the unit in which the numbers of an entry are readable."""
    unit, largest = entry["unit"], max(abs(entry["a_median"]), abs(entry["b_median"]))
    small = {"m": 0.1, "s": 1.0}
    if unit in small and 0 < largest < small[unit]:
        return 1e3, f"m{unit}"
    return 1.0, "" if unit == "1" else unit


def _needed(entry: Mapping[str, Any]) -> str:
    needed = entry["pairs_needed"]
    if needed is None:
        return "no effect seen"
    return f"about {needed} pairs" if needed <= 1000 else "above 1000 pairs"


def answer(document: Mapping[str, Any]) -> str:
    """Answer in one sentence: by success if it differs, else by the first number."""
    success = document["success"]
    if success["p_mcnemar"] < 0.05:
        more, less = "BA" if success["b"] > success["a"] else "AB"
        counts = [f"{success[side]} of {success['count']}" for side in (more.lower(), less.lower())]
        return (
            f"{more} succeeds more often than {less}: {counts[0]} against {counts[1]} flights, "
            f"p = {success['p_mcnemar']:.2g}."
        )
    if not document["numbers"]:
        return "Undecided: the flights have none of the numbers; name one with --number."
    name, entry = next(iter(document["numbers"].items()))
    (factor, unit), count = _scale(entry), entry["count"]
    p = f"p = {entry['p_wilcoxon']:.2g}"
    if not entry["decided"]:
        return f"Undecided: {name} after {count} pairs, {p}; to decide: {_needed(entry)}."
    word, times = ("lower", entry["lower"]) if entry["difference"] < 0 else (
        "higher", entry["higher"])  # fmt: skip
    low, high = sorted(abs(bound) * factor for bound in entry["interval"])
    size = format_number(abs(entry["difference"]) * factor)
    return (
        f"B has a {word} {name}: by {size} {unit} ({format_number(low)} .. {format_number(high)}), "
        f"{p}, {times} of {count} pairs."
    )
