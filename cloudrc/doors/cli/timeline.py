# SPDX-License-Identifier: Apache-2.0

"""`cloudrc timeline RUN`: where does the age of the commands come from?"""

from __future__ import annotations

from pathlib import Path

from cloudrc.base.outside.paths import check_new
from cloudrc.base.text import escape
from cloudrc.doors.cli.output import output_argument, print_result
from cloudrc.doors.cli.parser import Options, Parser, number

SHOWN = 60.0
"""How much of a flight the file has, unless a flag says more [s]."""
LIMIT = 1e6
"""Latest time since the start of a mission [s]."""
EPILOG = """\
examples:
  cloudrc timeline runs/latest
  cloudrc timeline runs/latest --from 90 --to 120 --out climb.json
  cloudrc timeline runs/latest/mission.mcap -o json

Open the file in https://ui.perfetto.dev (it stays on your machine), or in
Chrome's chrome://tracing. The numbers are of the whole flight."""


def arguments(parser: Parser) -> None:
    """Declare the command's arguments."""
    about = "folder of a run or of a fleet, an MCAP file, or an episode of eval --keep timeline"
    parser.add_argument("run", metavar="RUN", type=Path, help=about)
    about = "file for the timeline (default: timeline.json in the run's folder)"
    parser.add_argument("--out", metavar="FILE", type=Path, help=about)
    about = "the file begins at this time of the mission (default: 0)"
    second = number(0, LIMIT, "seconds")
    parser.add_argument("--from", metavar="S", type=second, default=0.0, dest="begin", help=about)
    about = "it ends at this time (default: 60 s later)"
    parser.add_argument("--to", metavar="S", type=second, dest="end", help=about)
    output_argument(parser)


def execute(options: Options) -> None:
    """Write the timeline, and print the budget of each robot."""
    from cloudrc.base.files import write_atomically
    from cloudrc.doors.cli.progress import Progress
    from cloudrc.results.timeline.loops import of_fleet
    from cloudrc.results.timeline.read import FILE, read_loops
    from cloudrc.results.timeline.text import as_text, fleet_text
    from cloudrc.results.timeline.trace import write_trace

    run, begin, out = options.run, options.begin, options.out
    if out is not None:
        check_new(out, "name another file with --out")
    with Progress(f"reads the recording of {run}"):
        loops = read_loops(run)
        end = begin + SHOWN if options.end is None else options.end
        path = out or (run / FILE if run.is_dir() else run.with_name(f"{run.stem}-{FILE}"))
        write_atomically(path, write_trace(loops, begin, end))
    if len(loops) == 1:
        budgets = {name: loop.document for name, loop in loops.items()}
        found, text = {"budgets": budgets}, as_text(*budgets.values())
    else:
        found = of_fleet(loops)
        text = fleet_text(found)
    document = {**found, "timeline": str(path)}
    print_result(options.output, document, f"{text}\n\n{escape(str(path))}")
