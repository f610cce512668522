# SPDX-License-Identifier: Apache-2.0

"""`cloudrc compare A B`: compare flights with the settings A and B; print p values."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from cloudrc.base.errors import BadInputError, CloudrcError
from cloudrc.base.outside.refusal import naming
from cloudrc.base.text import csv_table, latex_table
from cloudrc.doors.cli.output import TABLES, output_argument, print_result, tell, warn_about
from cloudrc.doors.cli.parser import Options, Parser, read_count, set_argument

if TYPE_CHECKING:
    from cloudrc.studies.compare import Pairs

EPILOG = """\
A and B are one of:
  settings           KEY=VALUE[,KEY=VALUE...]: fly both with each seed
  values of an axis  of the finished sweep in --in DIR
  runs               with --budget: their folders, or MCAP files

examples:
  cloudrc compare cloud.predictor=constant_velocity \\
    cloud.predictor=constant_acceleration --set link.profile=paper-p3
  cloudrc compare cloud.predictor=last_sample \\
    cloud.predictor=constant_velocity,cloud.estimator=split --metric iae_mean
  cloudrc compare cloud.estimator=running_mean cloud.estimator=split \\
    --set link.profile=handover --metric delay_estimate_error_rms
  cloudrc compare runs/before runs/after --budget
  cloudrc compare constant_velocity constant_acceleration --in runs/sweep-grid-1"""


def arguments(parser: Parser) -> None:
    """Declare the command's arguments."""
    parser.add_argument("a", metavar="A", help="the setting to compare with")
    parser.add_argument("b", metavar="B", help="the setting to judge")
    flight_arguments(parser, seeds=10)
    parser.add_argument(
        "--in", dest="sweep", type=Path, metavar="DIR", help="compare flights of this sweep"
    )
    about = "compare this metric instead of the default ones; repeatable"
    parser.add_argument("--metric", action="append", default=[], metavar="NAME", help=about)
    about = "fly each seed once more without a network; compare J/J0, the cost of control relative"
    where = "where the setpoint waits for the robot off_ideal_path and T/T0"
    parser.add_argument(
        "--cost", action="store_true", help=f"{about} to that flight, {where}, and the bytes"
    )
    about = (
        "compare the stages of the age of the commands: which one did the change move? A and B may"
        " be two runs"
    )
    parser.add_argument("--budget", action="store_true", help=about)
    output_argument(parser, forms=TABLES)


def flight_arguments(parser: Parser, seeds: int) -> None:
    """Declare --of, --set and --seeds; `seeds` is the default number of seeds."""
    about = "experiment to fly: a shipped name or a YAML file (default: steps)"
    parser.add_argument(
        "--of", dest="experiment", default="steps", metavar="EXPERIMENT", help=about
    )
    set_argument(parser)
    about = f"fly seeds 1 to N (default: {seeds})"
    parser.add_argument("--seeds", type=read_count, default=seeds, metavar="N", help=about)


def execute(options: Options) -> int:
    """Compare A and B, print the result, and return the exit code: 0 if all flights were flown."""
    from cloudrc.doors.cli.progress import Progress
    from cloudrc.studies.compare import budget_numbers, compare, of_sweep
    from cloudrc.studies.compare_text import as_text, cells

    stopped = None
    if options.budget and not options.sweep and "=" not in options.a + options.b:
        _compare_runs(options)
        return 0
    if options.set and options.sweep:
        raise BadInputError(f"--set {options.set[0]}: these flights are finished; leave it out")
    if options.cost and options.sweep:
        raise BadInputError(
            "--cost: these flights are finished; give the sweep's file 'cost: true'"
        )
    if options.sweep:
        with Progress(f"reads {options.sweep}"):
            found = of_sweep(options.sweep, options.a, options.b)
    else:
        found, stopped = _fly_both(options)
    if stopped:
        tell(f"{stopped}: {len(found.pairs)} pairs are finished")
        if not found.pairs:
            return stopped.exit_code
    with Progress(f"compares {len(found.pairs):,} pairs of flights"):
        names = budget_numbers(found.pairs) if options.budget else options.metric
        compared = compare(found.pairs, found.units, names)
    document = {
        **{"a": options.a, "b": options.b, "of": found.what},
        **{"overrides": options.set, "interrupted": bool(stopped)},
        **compared,
    }
    rows = []
    for name, each in document["numbers"].items():
        low, high = each["interval"] or (None, None)
        rows.append({"number": name, **each, "low": low, "high": high})
        del rows[-1]["interval"]
    tables = {"csv": csv_table(rows), "latex": latex_table(cells(document))}
    print_result(options.output, document, as_text(document), **tables)
    return stopped.exit_code if stopped else 0


def _compare_runs(options: Options) -> None:
    """Print the budgets of two runs side by side."""
    from cloudrc.base.text import table
    from cloudrc.doors.cli.progress import Progress
    from cloudrc.results.timeline.read import read_loops
    from cloudrc.results.timeline.text import side_by_side

    budgets = []
    for run in (options.a, options.b):
        with Progress(f"reads the recording of {run}"):
            loops = read_loops(Path(run))
            budgets.append({name: loop.document for name, loop in loops.items()})
    with naming("--budget"):
        rows = side_by_side(*budgets)
    cells = [tuple(rows[0]), *(tuple(row.values()) for row in rows)]
    document = {"a": options.a, "b": options.b, "budgets": budgets}
    text = "\n".join([f"A: {options.a}", f"B: {options.b}", "", table(cells, right=range(1, 6))])
    tables = {"csv": csv_table(rows), "latex": latex_table(cells)}
    print_result(options.output, document, text, **tables)


def _fly_both(options: Options) -> tuple[Pairs, CloudrcError | None]:
    """Fly the experiment with the settings A and with the settings B, each with all seeds.

    Return the pairs of flights; and why the work ended early, or None.
    """
    from cloudrc.doors.cli.progress import SweepView
    from cloudrc.studies.compare import Pairs, fly_pairs, plan_sides, split_settings

    for text in (options.a, options.b):
        if "=" not in text:
            raise BadInputError(f"{text}: is not KEY=VALUE; for a value of a sweep, add --in DIR")
    sides = split_settings(options.a), split_settings(options.b)
    asked = options.experiment, options.set, *sides, options.seeds, options.metric
    plan = plan_sides(*asked, cost=options.cost)
    warn_about(plan)
    count = len(plan.flights)
    flown = "A, B and both without a network" if options.cost else "A and B"
    head = f"{plan.name}: {flown}, each with seeds 1 to {options.seeds}, {count} flights"
    with SweepView(head, count) as view:
        pairs, stopped = fly_pairs(plan, count, view.see)
    return Pairs(pairs, plan.units, f"experiment {options.experiment}"), stopped
