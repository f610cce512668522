"""`cloudrc report RUN`: rewrite the report of a recorded run."""

from __future__ import annotations

import argparse
from dataclasses import replace
from pathlib import Path

from cloudrc.cli.extras import require
from cloudrc.cli.output import format_document, output_argument
from cloudrc.errors import BadInputError

EPILOG = """\
examples:
  cloudrc report runs/latest
  cloudrc report runs/latest --metric ./overshoot.py
  cloudrc report runs/paper-local-seed1-1 -o json"""


def arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the command's arguments."""
    parser.add_argument("run", type=Path, metavar="RUN", help="the folder of a run")
    parser.add_argument(
        "--metric",
        action="append",
        default=[],
        metavar="FILE",
        help="also evaluate the metric in this Python file; repeatable. Files named by the run's"
        " configuration are never executed",
    )
    output_argument(parser)


def execute(options: argparse.Namespace) -> int:
    """Write the report from the recording; return the exit code of the run's verdict."""
    require("a report", ("record", "report"))
    if not options.run.is_dir():
        raise BadInputError(f"{options.run}: no such folder; name the folder of a run")
    from cloudrc import metrics
    from cloudrc.cli.run import exit_code, show
    from cloudrc.report.folder import read_run
    from cloudrc.report.write import write_report

    metrics.check(options.metric)
    recording, experiment, run = read_run(options.run)
    # The run may come from somebody else: never execute files that it names.
    unmeasured = metrics.not_measured(experiment.report.metrics, options.metric)
    run = replace(run, notes=(*run.notes, *unmeasured))
    document = write_report(options.run, recording, experiment, run, own=options.metric)
    if options.output != "table":
        print(format_document(document, options.output))
    else:
        show(document, options.run)
    return exit_code(document)
