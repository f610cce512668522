# SPDX-License-Identifier: Apache-2.0

"""`cloudrc place EXPERIMENT`: where should the controller run?"""

from __future__ import annotations

from pathlib import Path

from cloudrc.base.text import escape
from cloudrc.doors.cli.output import TABLE, again, output_argument, print_result, tell, warn
from cloudrc.doors.cli.parser import (
    COUNT_MAX,
    Options,
    Parser,
    number,
    read_count,
    read_list,
    set_argument,
    settings_from,
)
from cloudrc.flight.folder import results_folder

EPILOG = """\
examples:
  cloudrc place fast
  cloudrc place steps --compute 0,5,20,60 --robots 1,4,10
  cloudrc place fast --places onboard,./factory.yaml --set cloud.controller=mpc

A computing time holds for a core of speed 1; each place has a speed, see
'cloudrc list places'. The best place is where most robots succeed; of equal
ones the one with the shortest time in HOLD, then the smallest cross-track
error, then the shortest settling time. A place loses if the exact sign test
over the seeds finds it worse (p below 5 %); numbers that differ by less than
5 % count as equal. With --out DIR of an earlier call, only what is missing
flies."""


def arguments(parser: Parser) -> None:
    """Declare the command's arguments."""
    about = "a shipped name or a YAML file (default: fast)"
    parser.add_argument("experiment", nargs="?", default="fast", metavar="EXPERIMENT", help=about)
    times = read_list(number(0, 1000, "ms"))
    about = "computing times of a command in ms (default: 0,5,20,60)"
    parser.add_argument("--compute", type=times, default="0,5,20,60", metavar="MS,...", help=about)
    counts, names = read_list(read_count), read_list(str)
    about = "numbers of robots (default: 1)"
    parser.add_argument("--robots", type=counts, default="1", metavar="N,...", help=about)
    shipped = "onboard,edge,cloud"
    about = f"shipped places or YAML files (default: {shipped})"
    parser.add_argument("--places", type=names, default=shipped, metavar="PLACE,...", help=about)
    set_argument(parser)
    parser.add_argument(
        "--seeds", type=read_count, default=6, metavar="N", help="fly seeds 1 to N (default: 6)"
    )
    parser.add_argument(
        "--calm", action="store_true", help="fly without wind and without a payload"
    )
    about = "parallel processes (default: one per core)"
    parser.add_argument("--jobs", type=read_count, default=COUNT_MAX, metavar="N", help=about)
    about = "folder (default: a new one in runs/); if it has rows, fly the others"
    parser.add_argument("--out", type=Path, metavar="DIR", help=about)
    output_argument(parser)


def execute(options: Options) -> int:
    """Fly what is missing, and print the table; return 0 if all was flown."""
    from cloudrc.doors.cli.progress import Progress, SweepView
    from cloudrc.flight.trials.play import run
    from cloudrc.flight.trials.rows import Rows
    from cloudrc.studies.place import PlaceStudy, as_text, describe

    study = settings_from(options, PlaceStudy)
    with Progress("checks the flights"):
        points = study.plan()
    warn(*(trials[0].resolved for trials in points), seeds=study.seeds)
    name = points[0][0].resolved.name
    with results_folder(options.out, "place", name) as folder:
        rows = Rows(folder)
        missing = [trial for trials in points for trial in trials if trial.key not in rows.kept]
        air = "calm" if study.calm else "in wind, with a payload (--calm: without)"
        head = f"{name} {air}, seeds 1 to {study.seeds}, {len(missing)} flights"
        head = ": ".join(filter(None, (head, ", ".join(study.settings))))
        with SweepView(head, len(missing), on_stdout=options.output == TABLE) as view:
            stopped = run(missing, rows, options.jobs, view.see, in_order=False)
    if stopped:
        tell(f"{stopped}; {again(options.out, folder)}")
    document = {
        **{"experiment": name, "overrides": options.set, "disturbances": study.disturbances},
        **{"seeds": study.seeds, "interrupted": bool(stopped)},
        **describe(points, rows.kept),
    }
    print_result(options.output, document, f"\n{as_text(document)}\n\n{escape(str(folder))}")
    return stopped.exit_code if stopped else 0
