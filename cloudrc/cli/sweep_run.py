"""Carry out the actions of `cloudrc sweep`, and `cloudrc run --seeds N`: a sweep of one point."""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Generator, Sequence
from contextlib import closing
from pathlib import Path
from shlex import quote

from cloudrc.cli.cluster_flags import release_from_flags
from cloudrc.cli.output import (
    leave_message,
    print_line,
    print_or_drop,
    print_result,
    warn,
)
from cloudrc.cli.parser import FLIGHTS_MAX
from cloudrc.cli.progress import Progress, SeedsView, SweepView
from cloudrc.cli.report import print_traceback, summary
from cloudrc.errors import BadInputError, CloudrcError, describe_error
from cloudrc.files import write_atomically
from cloudrc.metrics.verdict import EXIT_CODES
from cloudrc.outside.paths import check_picture
from cloudrc.runs.experiment import check_mode
from cloudrc.runs.folder import new_folder
from cloudrc.runs.requirements import MODES, require
from cloudrc.studies import sweep
from cloudrc.studies.pods import fly_in_pods
from cloudrc.text import escape
from cloudrc.trials import summary as summaries
from cloudrc.trials.plan import PlannedFlight, SweepPlan, check, draft_of, read_draft, unpack
from cloudrc.trials.play import keep, play
from cloudrc.trials.play import run as play_missing
from cloudrc.trials.rows import Row, Rows
from cloudrc.trials.workers import map_in_order, take_each


def run(options: argparse.Namespace) -> int:
    """Fly the flights of a sweep whose results or recordings are missing; return the exit code."""
    _check_flags(options)
    plan = _check(options)  # before there is a folder
    with sweep.open_folder(options.out, f"sweep-{options.file.stem}", options.shard) as folder:
        rows = sweep.begin(folder, plan, options.shard)
        mine = sweep.flights_of(plan, options.shard)
        missing = [each for each in mine if each.key not in rows.kept]
        with closing(SweepView(_head(options, plan, mine, missing), len(missing))) as view:
            if options.on:
                stopped = keep(_fly_in_pods(options, plan, missing), rows, view.see)
            else:
                stopped = play_missing(missing, rows, options.jobs, view.see, in_order=False)
            if options.record and not stopped:
                view.tell("records flights")
                stopped = sweep.record_missing(
                    mine, rows.kept, options.record, folder, options.jobs
                )
        return _finish(options, plan, folder, mine, stopped)


def _head(
    options: argparse.Namespace,
    plan: SweepPlan,
    mine: Sequence[PlannedFlight],
    missing: Sequence[PlannedFlight],
) -> str:
    """Say what the command flies."""
    seeds = len(plan.draft.seeds)
    part = ", shard {} of {}".format(*options.shard) if options.shard else ""
    head = f"{plan.name}: {len(plan.points)} points x {seeds} seeds{part}: {len(mine)} flights"
    done = len(mine) - len(missing)
    return f"{head}, {done} done before" if done else head


def _finish(
    options: argparse.Namespace,
    plan: SweepPlan,
    folder: Path,
    mine: Sequence[PlannedFlight],
    stopped: CloudrcError | None,
) -> int:
    """Write summary and tables, print the result, and return the exit code."""
    if stopped:
        print_line(f"cloudrc: {stopped}; to continue: {_again(options, folder)}", sys.stderr)
    rows = sweep.finish(folder, plan)
    name = sweep.TABLE if len(rows) == len(plan.flights) else sweep.SUMMARY
    text = f"\n{summaries.count_verdicts(rows.values())}\n\n{escape(str(folder / name))}"
    print_result(options.output, sweep.read_summary(folder), text)
    if stopped:
        return stopped.exit_code
    return int(any(rows[each.key]["verdict"] != "success" for each in mine))


def _again(options: argparse.Namespace, folder: Path) -> str:
    """Return the command that flies what is missing, without the shard: no job may fly it now."""
    words = ["cloudrc", "sweep", "run", quote(str(options.file)), "--out", quote(str(folder))]
    if options.max_flights != FLIGHTS_MAX:
        words += ["--max-flights", str(options.max_flights)]
    if options.record:
        words += ["--record", options.record]
    if options.on:
        words += ["--on kubernetes, and its other flags"]
    return " ".join(words)


def _check_flags(options: argparse.Namespace) -> None:
    """Refuse flags that do not fit, and missing packages."""
    if not options.on:
        require("a sweep", MODES["virtual"] if options.record else ("world",))
    elif options.record or options.shard:
        raise BadInputError("--on kubernetes has no --record and no --shard; see --shards")
    if options.shard and options.out is None:
        raise BadInputError("--shard needs --out, the folder that all shards share")


def _check(options: argparse.Namespace) -> SweepPlan:
    """Check all points; print warnings."""
    draft = read_draft(options.file, options.max_flights)
    with closing(Progress(f"checks {draft.size}")):
        plan = check(draft)
    if options.on:
        from cloudrc.cluster.own_files import check_local_files

        for point in plan.points:
            check_local_files(point.model_dump(mode="json"), "or fly without --on")
    warn(*plan.points)
    return plan


def fly_again(options: argparse.Namespace) -> int:
    """Repeat a flight of a sweep with recording and report; exit with 6 if its records changed."""
    require("a report", MODES["virtual"])
    row, flight = sweep.find_row(options.folder, options.key)
    with closing(Progress(f"flies {flight.key} again")):
        report = sweep.fly_into(options.folder, flight, page=True)
    print_traceback(options, report)
    print_or_drop(summary(report, options.folder / flight.key))
    sweep.check_repeated(row, report)
    print_or_drop("\nthe records are those of the sweep", sys.stderr)
    return 0


def print_status(options: argparse.Namespace) -> int:
    """Print how many flights of a sweep are done, and how many succeeded per value of an axis."""
    with closing(Progress(f"reads {options.folder}")):
        found = sweep.read_sweep(options.folder)
        values = sweep.count_successes(found)
    document = {"flights": found.flights, "rows": len(found.rows), "axes": values}
    print_result(options.output, document, sweep.status_text(found, values))
    return 0


def draw_figure(options: argparse.Namespace) -> int:
    """Draw a sweep and write the figure as PDF, PNG and SVG; print the caption and the paths."""
    require("a figure", ("report",))
    from cloudrc.report.figures.style import Look
    from cloudrc.studies.figure import draw_sweep

    if options.x is not None and options.x == options.by:
        raise BadInputError(f"--x and --by are both {options.x}; name two axes, or leave one out")
    look = Look(options.width, options.font_size)
    with closing(Progress(f"draws {options.folder}")):
        found = sweep.read_flights(options.folder)
        if not any(row["point"] for row in found.rows):
            text = "this sweep has no axis; give its file a grid, or see its metrics in table.csv"
            raise BadInputError(f"{options.folder}: {text}")
        shown = options.number, options.x, options.by
        files, caption = draw_sweep(found.rows, found.units, *shown, look)
    out = options.out or options.folder / "figure"
    stem = out.stem if out.suffix.removeprefix(".") in files else out.name
    paths = {kind: out.with_name(f"{stem}.{kind}") for kind in files}
    for path in paths.values():
        check_picture(path, "--out")
    print_or_drop(caption + (f" {found.missing}." if found.missing else "") + "\n")
    for kind, path in paths.items():
        write_atomically(path, files[kind])
        print_or_drop(escape(str(path)))
    return 0


# Sweeps in pods, which run `cloudrc sweep rows`.


def _fly_in_pods(
    options: argparse.Namespace, plan: SweepPlan, flights: Sequence[PlannedFlight]
) -> Generator[Row]:
    from cloudrc.cluster.batch import PodSettings

    pods = PodSettings(options.shards, options.image, options.cpu, options.queue)

    def tell(text: str) -> None:
        print_line(f"  {text}", sys.stderr)

    return fly_in_pods(release_from_flags(options), pods, plan, flights, tell)


def print_rows(options: argparse.Namespace) -> int:
    """Fly one shard (part) of the flights in a file; print the result of each flight as a row.

    If the shard cannot be finished, leave the reason for Kubernetes, which flies the shard again.
    """
    shard, count = options.shard

    def print_row(row: Row) -> None:
        print(json.dumps(row, allow_nan=False), flush=True)

    try:
        flights = unpack(options.file)[shard - 1 :: count]
        stopped = take_each(map_in_order(play, flights, jobs=1), print_row)
    except Exception as error:
        leave_message(str(error) if isinstance(error, CloudrcError) else describe_error(error))
        raise
    if stopped:
        print_line(f"cloudrc: error: {stopped}", sys.stderr)
        leave_message(str(stopped))
        return stopped.exit_code
    return 0


# `cloudrc run --seeds N`.


def fly_seeds(options: argparse.Namespace) -> int:
    """Fly seeds 1 to N and print one table; return 0 if all runs succeed.

    If Ctrl-C or a killed worker ends the command early, the table shows the finished seeds only.
    """
    plan = check(draft_of(options.experiment, options.set, options.seeds))
    (experiment,), count = plan.points, len(plan.flights)
    check_mode(experiment, "virtual")
    warn(experiment)
    folder = new_folder(options.out, f"{plan.name}-virtual-{count}seeds", "latest-sweep")
    rows = sweep.begin(folder, plan)
    head = f"{plan.name}: mode virtual, seeds 1 to {count}, link {experiment.link.profile}"
    make = SeedsView if options.output == "table" else SweepView
    with closing(make(head, count)) as view:
        stopped = play_missing(plan.flights.values(), rows, count, view.see)
    sweep.finish(folder, plan)
    _print_first_traceback(options, rows)
    if stopped:
        text = f"\ncloudrc: {stopped}: {len(rows.kept)} of {count} seeds are finished"
        print_or_drop(text, sys.stderr)
    seen = [*rows.kept.values()]
    document = {
        **{"experiment": plan.name, "mode": "virtual", "interrupted": bool(stopped)},
        "overrides": list(options.set),
        **summaries.summarise(seen, plan.units),
        "runs": [{key: row[key] for key in ("seed", "verdict", "key", "text")} for row in seen],
    }
    text = f"\n{summaries.as_table(document, count)}\n\n{folder / sweep.SUMMARY}"
    print_result(options.output, document, text)
    if stopped:
        return stopped.exit_code
    return max(EXIT_CODES.get(row["verdict"], 1) for row in seen)


def _print_first_traceback(options: argparse.Namespace, rows: Rows) -> None:
    """With --debug, print the traceback of the first failure of a plug-in."""
    for row in [each for each in rows.kept.values() if "traceback" in each][:1]:
        print_traceback(options, row)
