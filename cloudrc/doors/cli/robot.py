# SPDX-License-Identifier: Apache-2.0

"""`cloudrc robot`: check a robot before it flies."""

from __future__ import annotations

from pathlib import Path

from cloudrc.base.errors import BadInputError
from cloudrc.doors.cli.output import (
    output_argument,
    print_result,
)
from cloudrc.doors.cli.parser import Options, Parser, add_verbs

VERBS = {"check": "say what a robot is, fly it in virtual time, and say what must change"}
EPILOG = """\
examples:
  cloudrc robot check ./my_robot                 also writes my_robot/check.png
  cloudrc robot check quadrotor.xml --picture quadrotor.svg
  cloudrc robot check rover -o json

exit code 2: something must change"""


def arguments(parser: Parser) -> None:
    """Declare the command's arguments."""
    (check,) = add_verbs(parser, VERBS).values()
    about = "a folder with robot.yaml, an .xml file, or the name of a shipped robot"
    check.add_argument("robot", metavar="ROBOT", help=about)
    about = "picture to write: .png, .svg or .pdf (default: check.png in a folder of yours)"
    check.add_argument("--picture", type=Path, metavar="FILE", help=about)
    output_argument(check)


def execute(options: Options) -> int:
    """Check the robot; return 0, or 2 if something must change."""
    from cloudrc.doors.cli.progress import Progress
    from cloudrc.flight.runs.robot_check import as_text, check_robot

    with Progress(f"flies {options.robot}"):
        document, note = check_robot(options.robot, options.picture)
    print_result(options.output, document, as_text(document, note))
    return BadInputError.exit_code if document["changes"] else 0
