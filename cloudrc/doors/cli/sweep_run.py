# SPDX-License-Identifier: Apache-2.0

"""Carry out the actions of `cloudrc sweep`, and `cloudrc run --seeds N`: a sweep of one point."""

from __future__ import annotations

import json
import secrets
from collections.abc import Sequence
from typing import TYPE_CHECKING

from cloudrc.base.errors import BadInputError, CloudrcError
from cloudrc.base.files import read_json, write_atomically, write_json
from cloudrc.base.outside.paths import check_picture
from cloudrc.base.requirements import MODES, require
from cloudrc.base.text import escape
from cloudrc.config.overrides import parse_settings
from cloudrc.config.sweep import draft_of
from cloudrc.doors.cli.output import (
    again,
    leave_message,
    print_line,
    print_or_drop,
    print_result,
    tell,
    warn,
    warn_about,
)
from cloudrc.doors.cli.parser import Options
from cloudrc.doors.cli.progress import Progress, SeedsView, SweepView
from cloudrc.doors.cli.report import print_traceback, summary
from cloudrc.doors.cli.where import release_from_flags
from cloudrc.flight.experiment import check_mode
from cloudrc.flight.folder import new_folder
from cloudrc.flight.trials import summary as summaries
from cloudrc.flight.trials.bucket import open_rows
from cloudrc.flight.trials.plan import PlannedFlight, SweepPlan, check, read_draft, unpack
from cloudrc.flight.trials.play import keep
from cloudrc.flight.trials.play import run as play_missing
from cloudrc.flight.trials.rows import Row
from cloudrc.results.metrics.verdict import EXIT_CODES
from cloudrc.studies import sweep
from cloudrc.studies.pods import fly_in_pods

if TYPE_CHECKING:
    from cloudrc.cluster.batch import PodSettings

POD_FLAGS = (
    *("context", "namespace", "release", "shards", "image", "cpu", "queue", "parallelism"),
    *("cpu_limit", "memory", "claim", "bucket", "set_job"),
)
"""Flags of a sweep on Kubernetes that `sweep attach` repeats."""


def run(options: Options) -> int:
    """Fly the flights of a sweep whose results or recordings are missing; return the exit code."""
    _check_flags(options)
    plan = _check(options)  # before there is a folder
    with sweep.open_folder(options.out, f"sweep-{options.file.stem}", options.shard) as folder:
        rows = sweep.begin(folder, plan, options.shard)
        if options.on:
            write_json(folder / sweep.PODS, {name: getattr(options, name) for name in POD_FLAGS})
        mine = sweep.flights_of(plan, options.shard)
        missing = [each for each in mine if each.key not in rows.kept]
        with SweepView(_head(options, plan, mine, missing), len(missing)) as view:
            if options.on:
                release = release_from_flags(options)
                flown = fly_in_pods(release, _pods(options), plan, missing, tell)
                stopped = keep(flown, rows, view.see)
            else:
                stopped = play_missing(missing, rows, options.jobs, view.see, in_order=False)
            if options.record and not stopped:
                view.tell("records flights")
                stopped = sweep.record_missing(
                    mine, rows.kept, options.record, folder, options.jobs
                )
        if stopped:
            attach = f"to continue, cloudrc sweep attach {folder}"
            tell(f"{stopped}; {attach if options.on else again(options.out, folder)}")
        done = sweep.finish(folder, plan)
        name = sweep.TABLE if len(done) == len(plan.flights) else sweep.SUMMARY
        text = f"\n{summaries.count_verdicts(done.values())}\n\n{escape(str(folder / name))}"
        print_result(options.output, sweep.read_summary(folder), text)
    if stopped:
        return stopped.exit_code
    return int(any(done[each.key]["verdict"] != "success" for each in mine))


def _head(
    options: Options,
    plan: SweepPlan,
    mine: Sequence[PlannedFlight],
    missing: Sequence[PlannedFlight],
) -> str:
    """Say what the command flies."""
    seeds = len(plan.draft.seeds)
    part = ", shard {} of {}".format(*options.shard) if options.shard else ""
    part = ", also without a network" * plan.draft.cost + part
    head = f"{plan.name}: {len(plan.points)} points x {seeds} seeds{part}: {len(mine)} flights"
    done = len(mine) - len(missing)
    return f"{head}, {done} done before" if done else head


def _check_flags(options: Options) -> None:
    """Refuse flags that do not fit, and missing packages."""
    if not options.on:
        require("a sweep", MODES["virtual"] if options.record else ("world",))
    elif options.record or options.shard:
        raise BadInputError("--on kubernetes has no --record and no --shard; see --shards")
    elif options.claim and options.bucket:
        raise BadInputError("--claim and --bucket are two places for the rows; give one")
    if options.shard and options.out is None:
        raise BadInputError("--shard needs --out, the folder that all shards share")


def _check(options: Options) -> SweepPlan:
    """Check all points; print warnings."""
    draft = read_draft(options.file, options.max_flights)
    with Progress(f"checks {draft.size}"):
        plan = check(draft)
    if options.on:
        from cloudrc.cluster.batch import image_for
        from cloudrc.cluster.own_files import check_size

        if _pods(options).image is None:
            image_for(plan.points)  # there is one
        check_size(plan.own_files)
    warn_about(plan)
    return plan


def attach(options: Options) -> int:
    """Go on with a sweep on Kubernetes: find its Job, or create it again; return the exit code."""
    known = read_json(options.folder / sweep.PODS)
    if not known:
        text = "is no folder of 'cloudrc sweep run --on kubernetes'; name one"
        raise BadInputError(f"{options.folder}: {text}")
    own = {"file": options.folder / sweep.FILE, "out": options.folder, "on": "kubernetes"}
    vars(options).update(known, **own, max_flights=None, record=None, shard=None)
    return run(options)


def fly(options: Options) -> None:
    """Repeat a flight of a sweep with recording and report; exit with 6 if its records changed."""
    require("a report", MODES["virtual"])
    row, flight = sweep.find_row(options.folder, options.key)
    with Progress(f"flies {flight.key} again"):
        report = sweep.fly_into(options.folder, flight, page=True)
    print_traceback(options, report)
    print_or_drop(summary(report, options.folder / flight.key))
    sweep.check_repeated(row, report)
    tell("the records are those of the sweep")


def status(options: Options) -> None:
    """Print how many flights of a sweep are done, and how many succeeded per value of an axis."""
    with Progress(f"reads {options.folder}"):
        found = sweep.read_sweep(options.folder)
        values = sweep.count_by_value(found)
    document = {"flights": found.flights, "rows": len(found.rows), "axes": values}
    print_result(options.output, document, sweep.status_text(found, values))


def figure(options: Options) -> None:
    """Draw a sweep and write the figure as PDF, PNG and SVG; print the caption and the paths."""
    require("a figure", ("report",))
    from cloudrc.results.report.figures.style import Look
    from cloudrc.studies.figure import draw_sweep

    look = Look(options.width, options.font_size)
    with Progress(f"draws {options.folder}"):
        found = sweep.read_flights(options.folder)
        if not any(row["point"] for row in found.rows):
            text = "this sweep has no axis; give its file a grid, or see its metrics in table.csv"
            raise BadInputError(f"{options.folder}: {text}")
        shown = options.metric, options.x, options.by
        files, caption = draw_sweep(found.rows, found.units, *shown, look)
    out = options.out or options.folder / "figure"
    stem = out.stem if out.suffix.removeprefix(".") in files else out.name
    paths = {kind: out.with_name(f"{stem}.{kind}") for kind in files}
    for path in paths.values():
        check_picture(path, "--out")
    print_or_drop(caption + (f" {found.missing}." if found.missing else "") + "\n")
    for kind, path in paths.items():
        write_atomically(path, files[kind])
        print_line(str(path))


# Sweeps in pods, which run `cloudrc sweep rows`.


def _pods(options: Options) -> PodSettings:
    """Return the pods that the flags ask for."""
    require("a cluster", ("kube",))
    from cloudrc.cluster.batch import PodSettings, unknown_field

    settings = parse_settings(options.set_job, "--set-job", "priorityClassName=low")
    changes = {path: each.value for path, each in settings.items()}
    if text := unknown_field(changes):
        raise BadInputError(f"--set-job {text}")
    given = {name: getattr(options, name) for name in PodSettings._fields if name in POD_FLAGS}
    return PodSettings(**given, changes=changes)


def rows(options: Options) -> None:
    """Fly one shard (part) of the flights in a file; print the result of each flight as a row.

    With `--out`, keep the rows there, and fly only those that are missing.
    If the shard cannot be finished, leave the reason for Kubernetes, which flies the shard again.
    """
    shard, count = options.shard

    def print_row(row: Row) -> None:
        print(json.dumps(row, allow_nan=False), flush=True)

    try:
        kept = open_rows(options.out, f"{shard}-{secrets.token_hex(4)}")
        flights = unpack(options.file)[shard - 1 :: count]
        for flight in flights:
            if flight.key in kept.kept:
                print_row(kept.kept[flight.key])
        if stopped := play_missing(flights, kept, 1, print_row):
            raise stopped
    except (CloudrcError, OSError) as error:
        leave_message(str(error))
        raise


# `cloudrc run --seeds N`.


def fly_seeds(options: Options) -> int:
    """Fly seeds 1 to N and print one table; return 0 if all runs succeed.

    If Ctrl-C or a killed worker ends the command early, the table shows the finished seeds only.
    """
    plan = check(draft_of(options.experiment, options.set, options.seeds))
    (experiment,), count = plan.points, len(plan.flights)
    check_mode(experiment, "virtual")
    warn(experiment, seeds=count)
    folder = new_folder(options.out, f"{plan.name}-virtual-{count}seeds", "latest-sweep")
    rows = sweep.begin(folder, plan)
    head = f"{plan.name}: mode virtual, seeds 1 to {count}, {experiment.network}"
    is_table = options.output == "table"
    make = SeedsView if is_table else SweepView
    with make(head, count, on_stdout=is_table) as view:
        stopped = play_missing(plan.flights.values(), rows, count, view.see)
    sweep.finish(folder, plan)
    for row in [each for each in rows.kept.values() if "traceback" in each][:1]:
        print_traceback(options, row)
    if stopped:
        tell(f"{stopped}: {len(rows.kept)} of {count} seeds are finished")
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
