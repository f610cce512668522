# SPDX-License-Identifier: Apache-2.0

"""`cloudrc check`: check a robot or a plug-in before it flies."""

from __future__ import annotations

from pathlib import Path

from cloudrc.base.errors import BadInputError
from cloudrc.base.text import escape
from cloudrc.doors.cli.output import output_argument, print_result
from cloudrc.doors.cli.parser import Options, Parser

KINDS = {
    "predictor": "predictors",
    "estimator": "estimators",
    "controller": "controllers",
    "perception": "perceptions",
    "metric": "metrics",
    "executor": "executors",
}
"""Kind as it is typed -> kind of plug-in."""
EPILOG = """\
examples:
  cloudrc check ./my_robot                 also writes my_robot/check.png
  cloudrc check quadrotor.xml --picture quadrotor.svg
  cloudrc check rover -o json
  cloudrc check ./my_predictor.py
  cloudrc check constant_velocity --as predictor

A robot moves in virtual time: facts, and what must change. A plug-in is held to
the contract of its kind, then flies some seconds in virtual time; an executor
plays an episode, a metric measures a flight.

exit codes: 0 in order, 1 the plug-in fails, 2 something of the robot must
  change, or neither a robot nor a plug-in"""


def arguments(parser: Parser) -> None:
    """Declare the command's arguments."""
    about = (
        "a robot: a folder with robot.yaml, an .xml file, or the name of a shipped one; or a"
        " plug-in: a Python file"
    )
    parser.add_argument("path", metavar="PATH", help=about)
    about = "kind of the plug-in (default: by its methods)"
    parser.add_argument("--as", dest="kind", choices=[*KINDS], metavar="KIND", help=about)
    about = "picture of the robot: .png, .svg or .pdf (default: check.png in a folder of yours)"
    parser.add_argument("--picture", type=Path, metavar="FILE", help=about)
    output_argument(parser)


def execute(options: Options) -> int:
    """Check a robot or a plug-in; return the exit code."""
    if options.kind or options.path.endswith(".py"):
        return _check_plugin(options)
    from cloudrc.doors.cli.progress import Progress
    from cloudrc.doors.robot_check import as_text, check_robot

    with Progress(f"flies {options.path}"):
        document, note = check_robot(options.path, options.picture)
    print_result(options.output, document, as_text(document, note))
    return BadInputError.exit_code if document["changes"] else 0


def _check_plugin(options: Options) -> int:
    from cloudrc.doors.cli.progress import Progress
    from cloudrc.studies.check import as_text, check_plugin

    with Progress(f"checks {options.path}"):
        found = check_plugin(options.path, KINDS.get(options.kind))
    text = f"{found['kind']} {escape(options.path)}\n{as_text(found)}"
    print_result(options.output, {"plugin": options.path, **found}, text)
    return 0 if found["ok"] else 1
