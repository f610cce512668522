# SPDX-License-Identifier: Apache-2.0

"""`cloudrc report RUN`: write the report of a recorded run again, and print a summary.

With `--recover`, `report_recover.py` copies its recordings instead.
"""

from __future__ import annotations

import sys
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from shlex import quote
from typing import TYPE_CHECKING, Any

from cloudrc.base.errors import BadInputError
from cloudrc.base.text import escape
from cloudrc.doors.cli.output import output_argument, paint, print_lines, print_result
from cloudrc.doors.cli.parser import Options, Parser, figure_arguments

if TYPE_CHECKING:
    from cloudrc.config.resolved import ResolvedExperiment
    from cloudrc.results.record.columns import Recording
    from cloudrc.results.report.figures.style import Look

PAGE = "report.html"
EPILOG = """\
examples:
  cloudrc report runs/latest
  cloudrc report runs/latest --metric ./overshoot.py
  cloudrc report runs/latest --figures --width 3.5 --font-size 8
  cloudrc report runs/paper-local-seed1-1 -o json
  cloudrc report world.mcap --recover           writes world.recovered.mcap

exit codes of --recover: 0 copied, and what is missing is printed, 2 nothing
  readable, or still in flight"""


def arguments(parser: Parser) -> None:
    """Declare the command's arguments."""
    about = "the folder of a run; with --recover also one recording, FILE.mcap"
    parser.add_argument("run", type=Path, metavar="RUN", help=about)
    about = (
        "also evaluate the metric in this Python file; repeatable. Files named by the run's"
        " configuration are never executed"
    )
    parser.add_argument("--metric", action="append", default=[], metavar="FILE", help=about)
    files_argument(parser)
    figure_arguments(parser, 7.16)
    about = "write no report, but a clean copy of a damaged recording"
    parser.add_argument("--recover", action="store_true", help=about)
    about = "file for this copy (default: beside it, with '.recovered' before its ending)"
    parser.add_argument("-t", "--to", type=Path, metavar="NEW", help=about)
    output_argument(parser)


def report_arguments(parser: Parser) -> None:
    """Declare the arguments that say which files a flight's report has."""
    about = "page: write report.html (default); none: the recording and report.json alone"
    parser.add_argument("--report", choices=["page", "none"], default="page", help=about)
    files_argument(parser)


def files_argument(parser: Parser) -> None:
    """Declare the argument for the files of the figures."""
    about = "also write each figure as PDF, PNG and SVG into the run's folder figures/"
    parser.add_argument("--figures", action="store_true", help=about)


def execute(options: Options) -> int:
    """Write the report from the recording; return the exit code of the run's verdict."""
    if options.recover:
        from cloudrc.doors.cli.report_recover import recover

        recover(options)
        return 0
    if options.to:
        raise BadInputError("--to: is the file of --recover; give both")
    if not options.run.is_dir():
        raise BadInputError(f"{options.run}: no such folder; name the folder of a run")
    look = options.width, options.font_size
    return write(options, options.run, options.metric, figures=options.figures, look=look)


def write(
    options: Options,
    run: Path,
    metrics: Sequence[str] = (),
    *,
    figures: bool = False,
    look: tuple[float, ...] = (),
) -> int:
    """Write the report of a run or fleet, with a user's `metrics`; return the verdict's exit code.

    `look` are the width of figures [in] and the size of their text [points].
    """
    from cloudrc.results.metrics import measure
    from cloudrc.results.metrics.verdict import exit_code
    from cloudrc.results.report.figures.style import Look
    from cloudrc.results.report.fleet import summarize_fleet
    from cloudrc.results.report.folder import robots_in

    measure.check(metrics)
    is_fleet = bool(robots_in(run))
    document = _write(run, metrics, is_fleet=is_fleet, figures=figures, look=Look(*look))
    print_traceback(options, document)
    if is_fleet:
        text = f"\n{summarize_fleet(document, paint)}\n\n{escape(str(run / PAGE))}"
    else:
        text = summary(document, run)
    print_result(options.output, document, text)
    return exit_code(document)


def _write(
    run: Path, metrics: Sequence[str], *, is_fleet: bool, figures: bool, look: Look
) -> dict[str, Any]:
    from cloudrc.doors.cli.progress import Progress
    from cloudrc.flight.fleet import write_again
    from cloudrc.flight.session import restore_mission
    from cloudrc.results.metrics import measure
    from cloudrc.results.record.topics import TOPICS
    from cloudrc.results.report.folder import check_ended, read_run
    from cloudrc.results.report.write import write_report

    with Progress(f"reads the recording of {run}") as view:

        def write_one(folder: Path) -> tuple[Recording, ResolvedExperiment, dict[str, Any]]:
            check_ended(folder)
            restore_mission(folder)
            recording, experiment, facts = read_run(folder)
            # The run may come from somebody else: never execute files that it names.
            unmeasured = measure.not_measured(experiment.report.metrics, metrics)
            facts = replace(facts, notes=(*facts.notes, *unmeasured))
            count = sum(len(recording[topic]) for topic in TOPICS)
            view.tell(f"measures {count:,} messages and draws the figures")
            document = write_report(
                *(folder, recording, experiment, facts),
                own=metrics,
                page=not is_fleet,
                figures=figures,
                look=look,
            )
            return recording, experiment, document

        return write_again(run, write_one) if is_fleet else write_one(run)[2]


def summary(report: Mapping[str, Any], folder: Path, last: str = PAGE) -> str:
    """Summarize a report as text, and say where the replay and the file `last` are."""
    from cloudrc.results.report.summary import summarize

    replay = f"replay in 3-D: cloudrc replay {quote(str(folder))}"
    return "\n".join(["", summarize(report, paint), "", escape(replay), escape(str(folder / last))])


def print_traceback(options: Options, report: Mapping[str, Any]) -> None:
    """With --debug, print the traceback of the first failure of a plug-in to stderr."""
    if "debug" in options and "traceback" in report:
        print_lines(report["traceback"].splitlines(), sys.stderr)
