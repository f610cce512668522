# SPDX-License-Identifier: Apache-2.0

"""`cloudrc new`: write the files of a robot of one's own."""

from __future__ import annotations

from pathlib import Path
from shlex import quote

from cloudrc.cli.parser import Options, Parser, add_verbs

VERBS = {"robot": "write a folder with a robot that flies, to change"}
EPILOG = """\
examples:
  cloudrc new robot ./my_robot       robot.yaml, robot.xml and a test
  cloudrc robot check ./my_robot"""


def arguments(parser: Parser) -> None:
    """Declare the command's arguments."""
    (robot,) = add_verbs(parser, VERBS).values()
    robot.add_argument("folder", type=Path, metavar="DIR", help="folder for the files")


def execute(options: Options) -> None:
    """Write the files, and print what to type next."""
    from cloudrc.runs.new_robot import write_robot

    folder = options.folder
    names = write_robot(folder)
    path = folder if folder.is_absolute() or folder.parts[:1] == ("..",) else f"./{folder}"
    typed = quote(str(path))
    print(
        f"change {', '.join(names)} in {folder}, then:\n"
        f"  cloudrc robot check {typed}\n"
        f"  cloudrc run steps --mode virtual --set world.robot={typed}\n"
        f"  pytest {typed}"
    )
