# SPDX-License-Identifier: Apache-2.0

"""`cloudrc new`: write the files of a robot or of a plug-in of one's own."""

from __future__ import annotations

from pathlib import Path
from shlex import quote

from cloudrc.doors.cli.parser import Options, Parser, add_verbs
from cloudrc.doors.new import NEW, OF_CAMERA, write

EPILOG = """\
examples:
  cloudrc new robot ./my_robot       robot.yaml, robot.xml and a test
  cloudrc new predictor ./my_predictor.py
  cloudrc check ./my_predictor.py
  cloudrc new perception ./my_perception.py             drives by scans
  cloudrc new perception ./my_perception.py --camera    flies by pictures

What is written flies as it is. A plug-in has a test beside it, test_NAME.py,
that pytest runs."""


def arguments(parser: Parser) -> None:
    """Declare the command's arguments."""
    verbs = add_verbs(parser, {kind: f"write {new.about}" for kind, new in NEW.items()})
    for kind, verb in verbs.items():
        is_robot = kind == "robot"
        about = "folder for the files" if is_robot else "Python file, NAME.py"
        verb.add_argument("path", type=Path, metavar="DIR" if is_robot else "FILE", help=about)
    verbs["perception"].add_argument(
        "--camera", action="store_true", help="for a robot with a camera, in place of a scanner"
    )


def execute(options: Options) -> None:
    """Write the files, and print what to type next."""
    new = OF_CAMERA if getattr(options, "camera", False) else NEW[options.verb]
    *_, test = write(new, options.path)
    typed = _typed(options.path)
    print(
        f"change {new.changes} in {options.path}, then:\n"
        f"  cloudrc check {typed}\n"
        f"  {new.command.format(path=typed)}\n"
        f"  pytest {_typed(test)}"
    )


def _typed(path: Path) -> str:
    """Return a path as it is typed where a name without a folder means a shipped file."""
    return quote(str(path if path.is_absolute() or path.parts[:1] == ("..",) else f"./{path}"))
