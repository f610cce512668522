"""Carry out the actions of `cloudrc sweep`, and `cloudrc run --seeds N`: a sweep of one point."""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Generator, Sequence
from contextlib import closing, suppress
from pathlib import Path
from shlex import quote

from cloudrc import metrics
from cloudrc.cli.cluster_flags import release_from_flags
from cloudrc.cli.mission import TERMINATION_LOG
from cloudrc.cli.output import (
    print_line,
    print_or_drop,
    print_result,
    warn,
)
from cloudrc.cli.parser import FLIGHTS_MAX
from cloudrc.cli.progress import Progress, SeedsView, SweepView
from cloudrc.cli.report import print_traceback, summary
from cloudrc.errors import BadInputError, CloudrcError, describe_error
from cloudrc.files import PICTURES, refuse_other_file, write_atomically
from cloudrc.metrics.verdict import EXIT_CODES
from cloudrc.runs import seeds, store, sweep
from cloudrc.runs.experiment import check_mode, load, refuse_seed
from cloudrc.runs.flight import Row
from cloudrc.runs.folder import new_folder
from cloudrc.runs.grid import Grid, SweepPoint, check, read_unchecked, unpack
from cloudrc.runs.pods import PodSettings, fly_in_pods
from cloudrc.runs.requirements import MODES, require
from cloudrc.runs.workers import map_in_order, take_each
from cloudrc.text import escape


def run(options: argparse.Namespace) -> int:
    """Fly the flights of a sweep whose results or recordings are missing; return the exit code."""
    _check_flags(options)
    grid = _check(options)  # before there is a folder
    name, (shard, count) = f"sweep-{options.file.stem}", options.shard or (None, 1)
    with sweep.open_folder(options.out, name, shard, count) as (folder, warning):
        if warning:
            print_line(f"cloudrc: warning: {warning}", sys.stderr)
        return _run_locked(options, grid, folder, shard, count)


def _run_locked(
    options: argparse.Namespace, grid: Grid, folder: Path, shard: int | None, count: int
) -> int:
    """Fly what is missing in `folder`, which no other command may fly now; return the exit code."""
    work = sweep.begin(grid, folder, shard, count, options.record)
    mine, missing = work.mine, work.missing
    part = f", shard {shard} of {count}" if shard else ""
    points = len(grid.point_of) // len(grid.seeds)
    head = f"{points} points x {len(grid.seeds)} seeds{part}: {len(mine)} flights"
    head += f", {len(mine) - len(missing)} done before" if len(missing) < len(mine) else ""
    view = SweepView(f"{grid.name}: {head}", len(missing))
    with closing(view):
        if options.on:
            flown = _fly_in_pods(options, grid, missing)
        else:
            flown = sweep.fly_missing(work, folder, options.jobs, options.record)
        rows, stopped = sweep.keep(flown, folder, grid, shard, work.before, view.see)
    if stopped:
        print_line(f"cloudrc: {stopped}; to continue: {_again(options, folder)}", sys.stderr)
    name = store.TABLE if len(rows) == len(grid.point_of) else store.SUMMARY
    text = f"\n{sweep.count_verdicts(rows.values())}\n\n{escape(str(folder / name))}"
    print_result(options.output, store.read_summary(folder), text)
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


def _check(options: argparse.Namespace) -> Grid:
    """Check all points; print warnings."""
    unchecked = read_unchecked(options.file, options.max_flights)
    with closing(Progress(f"checks {unchecked.size}")):
        grid = check(unchecked)
    if options.on:
        from cloudrc.cluster.own_files import check_local_files

        for point in grid.points:
            check_local_files(point.model_dump(mode="json"), "or fly without --on")
    warn(*grid.points)
    return grid


def fly_again(options: argparse.Namespace) -> int:
    """Repeat a flight of a sweep with recording and report; exit with 6 if its records changed."""
    require("a report", MODES["virtual"])
    row, flight = sweep.find_flight(options.folder, options.key)
    key = flight.key
    with closing(Progress(f"flies {key} again")):
        report = sweep.fly_into(options.folder / key, flight, page=True)
    print_traceback(options, report)
    print_or_drop(summary(report, options.folder / key))
    sweep.check_repeated(row, report)
    print_or_drop("\nthe records are those of the sweep", sys.stderr)
    return 0


def print_status(options: argparse.Namespace) -> int:
    """Print how many flights of a sweep are done, and how many succeeded per value of an axis."""
    with closing(Progress(f"reads {options.folder}")):
        flights, rows, values = sweep.count_successes(options.folder)
    document = {"flights": flights, "rows": len(rows), "axes": values}
    print_result(options.output, document, sweep.status_text(flights, rows, values))
    return 0


def draw_figure(options: argparse.Namespace) -> int:
    """Draw a sweep and write the figure as PDF, PNG and SVG; print the caption and the paths."""
    require("a figure", ("report",))
    from cloudrc.report.figures.style import Look
    from cloudrc.runs.figure import draw_sweep

    look = Look(options.width, options.font_size)
    with closing(Progress(f"draws {options.folder}")):
        rows, units, missing = store.read_flights(options.folder)
        files, caption = draw_sweep(rows, units, options.number, options.x, options.by, look)
    out = options.out or options.folder / "figure"
    stem = out.stem if out.suffix.removeprefix(".") in files else out.name
    paths = {kind: out.with_name(f"{stem}.{kind}") for kind in files}
    for kind, path in paths.items():
        refuse_other_file(path, PICTURES[kind], flag="--out")
    print_or_drop(caption + (f" {missing}." if missing else "") + "\n")
    for kind, path in paths.items():
        write_atomically(path, files[kind])
        print_or_drop(escape(str(path)))
    return 0


# Sweeps in pods, which run `cloudrc sweep rows`.


def _fly_in_pods(
    options: argparse.Namespace, grid: Grid, flights: Sequence[SweepPoint]
) -> Generator[Row]:
    pods = PodSettings(options.shards, options.image, options.cpu, options.queue)

    def tell(text: str) -> None:
        print_line(f"  {text}", sys.stderr)

    return fly_in_pods(release_from_flags(options), pods, grid, flights, tell)


def print_rows(options: argparse.Namespace) -> int:
    """Fly one shard (part) of the flights in a file; print the result of each flight as a row.

    If the shard cannot be finished, leave the reason for Kubernetes, which flies the shard again.
    """
    try:
        stopped = _print_rows(options)
    except Exception as error:
        _leave_message(str(error) if isinstance(error, CloudrcError) else describe_error(error))
        raise
    if stopped:
        print_line(f"cloudrc: error: {stopped}", sys.stderr)
        _leave_message(str(stopped))
        return stopped.exit_code
    return 0


def _print_rows(options: argparse.Namespace) -> CloudrcError | None:
    shard, count = options.shard
    flights = unpack(options.file)[shard - 1 :: count]

    def print_row(row: Row) -> None:
        print(json.dumps(row, allow_nan=False), flush=True)

    return take_each(map_in_order(sweep.fly_row, flights, jobs=1), print_row)


def _leave_message(text: str) -> None:
    """Leave one sentence about the end of this pod, which Kubernetes shows with the pod's state."""
    if TERMINATION_LOG.exists():
        with suppress(OSError):
            TERMINATION_LOG.write_text(f"{escape(text)}\n", encoding="utf-8")


# `cloudrc run --seeds N`.


def fly_seeds(options: argparse.Namespace) -> int:
    """Fly seeds 1 to N and print one table; return 0 if all runs succeed.

    If Ctrl-C or a killed worker ends the command early, the table shows the finished seeds only.
    """
    refuse_seed(options.set)
    experiment = load(options.experiment, options.set)
    check_mode(experiment, "virtual")
    metrics.check(experiment.report.metrics)
    warn(experiment)
    name = experiment.name
    folder = new_folder(options.out, f"{name}-virtual-{options.seeds}seeds", "latest-sweep")
    grid = seeds.write_grid(folder, options.experiment, options.set, options.seeds)
    seen, count = list[Row](), len(grid.flights)
    head = f"{name}: mode virtual, seeds 1 to {options.seeds}, link {experiment.link.profile}"
    make = SeedsView if options.output == "table" else SweepView

    def see(row: Row) -> None:
        seen.append(row)
        view.see(row)
        if not any("traceback" in earlier for earlier in seen[:-1]):
            print_traceback(options, row)

    with closing(make(head, count)) as view:
        _, stopped = sweep.keep(
            seeds.fly_seeds(grid), folder, grid, None, store.begin(folder, grid), see
        )
    if stopped:
        text = f"\ncloudrc: {stopped}: {len(seen)} of {count} seeds are finished"
        print_or_drop(text, sys.stderr)
    document = {
        **{"experiment": name, "mode": "virtual", "interrupted": bool(stopped)},
        "overrides": list(options.set),
        **seeds.summarise(seen, store.read_summary(folder)["units"]),
        "runs": [{key: row[key] for key in ("seed", "verdict", "key", "text")} for row in seen],
    }
    text = f"\n{seeds.as_table(document, count)}\n\n{folder / store.SUMMARY}"
    print_result(options.output, document, text)
    if stopped:
        return stopped.exit_code
    return max(EXIT_CODES[row["verdict"]] for row in seen)
