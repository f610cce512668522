"""`cloudrc report RUN`: a recorded run comes in, its report is written again."""

from __future__ import annotations

import argparse
from pathlib import Path

from cloudrc.cli.extras import require
from cloudrc.cli.output import output_argument, written
from cloudrc.errors import BadInputError

EPILOG = """\
examples:
  cloudrc report runs/latest
  cloudrc report runs/paper-local-seed1-1 -o json"""


def arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the command's arguments."""
    parser.add_argument("run", type=Path, metavar="RUN", help="the folder of a run")
    output_argument(parser)


def execute(options: argparse.Namespace) -> int:
    """Write the report again from the recording; exit as the run did."""
    require("a report", ("record", "report"))
    if not options.run.is_dir():
        raise BadInputError(f"{options.run}: no such folder; name the folder of a run")
    from cloudrc.cli.closing import exit_code, show
    from cloudrc.report.write import read_run, write_report

    document = write_report(options.run, *read_run(options.run))
    if options.output != "table":
        print(written(document, options.output))
    else:
        show(document, options.run)
    return exit_code(document)
