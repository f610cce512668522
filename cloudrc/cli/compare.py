"""`cloudrc compare A B`: compare flights with the settings A and B; print p values."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Mapping
from contextlib import closing
from pathlib import Path
from typing import TYPE_CHECKING, Any

from cloudrc.cli.output import output_argument, print_or_drop, print_result, warn
from cloudrc.cli.parser import read_count
from cloudrc.errors import BadInputError, CloudrcError
from cloudrc.renamed import new_name
from cloudrc.runs.interrupts import interrupt_on_signals
from cloudrc.runs.requirements import MODES, require
from cloudrc.text import FAILED_MARK, FAILED_NOTE, format_number, table

if TYPE_CHECKING:
    from cloudrc.runs.compare import Pairs

EPILOG = """\
A and B are one of:
  settings           KEY=VALUE[,KEY=VALUE...]: fly both with each seed
  values of an axis  of the finished sweep in --in DIR

examples:
  cloudrc compare cloud.predictor=constant_velocity \\
    cloud.predictor=constant_acceleration --set link.profile=paper-p3
  cloudrc compare cloud.predictor=last_sample \\
    cloud.predictor=constant_velocity,cloud.estimator=split --number iae_mean
  cloudrc compare cloud.estimator=running_mean cloud.estimator=split \\
    --set link.profile=handover --number delay_estimate_error_rms
  cloudrc compare last_sample constant_velocity --in runs/sweep-steps-1"""
TITLES = (
    *("number", "A median", "B median", "B - A", "95 % interval", "B lower in", "p", "p sign"),
    *("decided", "unit"),
)


def arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the command's arguments."""
    add = parser.add_argument
    add("a", metavar="A", help="the setting to compare with")
    add("b", metavar="B", help="the setting to judge")
    flight_arguments(parser, seeds=10)
    add("--in", type=Path, dest="sweep", metavar="DIR", help="compare flights of this sweep")
    about = "compare this metric instead of the default ones; repeatable"
    add("--number", action="append", type=new_name, default=[], metavar="NAME", help=about)
    output_argument(parser)


def flight_arguments(parser: argparse.ArgumentParser, seeds: int) -> None:
    """Declare --of, --set and --seeds; `seeds` is the default number of seeds."""
    add = parser.add_argument
    about = "experiment to fly: a shipped name or a YAML file (default: steps)"
    add("--of", default="steps", dest="experiment", metavar="EXPERIMENT", help=about)
    about = "change one key of the experiment; repeatable"
    add("--set", action="append", default=[], metavar="KEY=VALUE", help=about)
    about = f"fly seeds 1 to N (default: {seeds})"
    add("--seeds", type=read_count, default=seeds, metavar="N", help=about)


def execute(options: argparse.Namespace) -> int:
    """Compare A and B, print the result, and return the exit code: 0 if all flights were flown."""
    interrupt_on_signals()
    from cloudrc.runs.compare import compare, of_sweep

    stopped = None
    if options.set and options.sweep:
        raise BadInputError(f"--set {options.set[0]}: these flights are finished; leave it out")
    if options.sweep:
        found = of_sweep(options.sweep, options.a, options.b)
    else:
        found, stopped = _fly_both(options)
    if stopped:
        print_or_drop(f"cloudrc: {stopped}: {len(found.pairs)} pairs are finished", sys.stderr)
        if not found.pairs:
            return stopped.exit_code
    document = {
        **{"a": options.a, "b": options.b, "of": found.what},
        **{"overrides": options.set, "interrupted": bool(stopped)},
        **compare(found.pairs, found.units, options.number),
    }
    print_result(options.output, document, as_text(document))
    return stopped.exit_code if stopped else 0


def _fly_both(options: argparse.Namespace) -> tuple[Pairs, CloudrcError | None]:
    """Fly the experiment with the settings A and with the settings B, each with all seeds.

    Return the pairs of flights; and why the work ended early, or None.
    """
    from cloudrc.cli.progress import SweepView
    from cloudrc.runs.compare import Pairs, fly_pairs, load_sides, split_settings

    for text in (options.a, options.b):
        if "=" not in text:
            raise BadInputError(f"{text}: is not KEY=VALUE; for a value of a sweep, add --in DIR")
    require("compare", MODES["virtual"])
    a, b = split_settings(options.a), split_settings(options.b)
    sides, unit_of = load_sides(options.experiment, options.set, a, b, options.number)
    warn(*sides)
    head = f"{sides[0].name}: A and B, each with seeds 1 to {options.seeds}"
    stream = sys.stdout if options.output == "table" else sys.stderr
    flights = 2 * options.seeds
    with closing(SweepView(stream, f"{head}, {flights} flights", flights)) as view:
        pairs, stopped = fly_pairs(sides, options.seeds, flights, view.see)
    return Pairs(pairs, unit_of, f"experiment {options.experiment}"), stopped


def as_text(document: Mapping[str, Any]) -> str:
    """Format the result of a comparison: a table and, in the last lines, the conclusion."""
    from cloudrc.runs.compare import LEFT_OUT

    body = [_row(name, entry) for name, entry in document["numbers"].items()]
    success, left_out = document["success"], document["left_out"]
    rates = [
        "{} {} of {} ({:.0%} .. {:.0%})".format(
            side.upper(), success[side], success["count"], *success[f"{side}_interval"]
        )
        for side in "ab"
    ]
    lines = [
        *(f"{side.upper()}: {document[side]}" for side in "ab"),
        f"of {document['of']}; pairs: {document['pairs']}"
        + (f"; {left_out} left out with {LEFT_OUT}" if left_out else ""),
        *("", table([TITLES, *body], right=(1, 2, 3)), ""),
        f"success: {', '.join(rates)}, p = {success['p_mcnemar']:.2g}",
        document["method"],
        *([FAILED_NOTE] if any(_failed(entry) for entry in document["numbers"].values()) else []),
        *("", _answer(document)),
    ]
    return "\n".join(lines)


def _row(name: str, entry: Mapping[str, Any]) -> tuple[str, ...]:
    factor, unit = _scaled(entry)
    values = [format_number(entry[key] * factor) for key in ("a_median", "b_median", "difference")]
    for place, side in enumerate("ab"):
        values[place] += FAILED_MARK if entry[f"{side}_failed"] else ""
    between = " .. ".join(format_number(bound * factor) for bound in entry["interval"] or ())
    return (
        *(name, *values, between or "-", f"{entry['lower']} of {entry['count']}"),
        *(f"{entry['p_wilcoxon']:.2g}", f"{entry['p_sign']:.2g}"),
        *("yes" if entry["decided"] else f"no: {_needed(entry)}", unit),
    )


def _failed(entry: Mapping[str, Any]) -> str:
    """Return in words how many flights behind a number failed; "" if none did."""
    failed = [
        f"{entry[f'{side}_failed']} of {side.upper()}'s" for side in "ab" if entry[f"{side}_failed"]
    ]
    return f"{' and '.join(failed)} {entry['count']} flights failed" if failed else ""


def _scaled(entry: Mapping[str, Any]) -> tuple[float, str]:
    from cloudrc.metrics import scale

    return scale(entry["unit"], max(abs(entry["a_median"]), abs(entry["b_median"])))


def _needed(entry: Mapping[str, Any]) -> str:
    needed = entry["pairs_needed"]
    if needed is None:
        return "more pairs needed" if entry["difference"] else "no effect seen"
    return f"about {needed} pairs needed" if needed <= 1000 else "above 1000 pairs needed"


def _answer(document: Mapping[str, Any]) -> str:
    """Say how B changes the first metric, and whether A or B succeeds significantly more often."""
    success, text = document["success"], ""
    if success["decided"]:
        more, less = "ba" if success["b"] > success["a"] else "ab"
        text = (
            f"{more.upper()} succeeds more often: in {success[more]} of {success['count']} flights,"
            f" {less.upper()} in {success[less]}, p = {success['p_mcnemar']:.2g}.\n"
        )
    if not document["numbers"]:
        return f"{text}No pair has one of the default numbers; name one with --number."
    name, entry = next(iter(document["numbers"].items()))
    p, count = f"p = {entry['p_wilcoxon']:.2g}", entry["count"]
    if not entry["decided"]:
        return (
            f"{text}Undecided: {name} after {count} pairs, {p}; {_needed(entry)}.{_cautions(entry)}"
        )
    sign, word = (1, "higher") if entry["difference"] > 0 else (-1, "lower")
    factor, unit = _scaled(entry)
    size, low, high = (
        format_number(sign * value * factor)
        for value in (entry["difference"], *entry["interval"][::sign])
    )
    return (
        f"{text}B has a {word} {name}: by {size}{unit and ' '}{unit} ({low} .. {high}), {p}, "
        f"in {entry[word]} of {count} pairs.{_cautions(entry)}"
    )


def _cautions(entry: Mapping[str, Any]) -> str:
    """Say what weakens the answer about a metric, each in a sentence after a space."""
    from cloudrc.statistics import LEVEL

    text = ""
    if entry["decided"] and entry["p_sign"] >= LEVEL:
        text += (
            " This holds if the differences are symmetric; the sign test, which does not assume "
            f"it, does not confirm it (p = {entry['p_sign']:.2g})."
        )
    if failed := _failed(entry):
        text += f" {failed}, and their numbers count."
    return text
