# SPDX-License-Identifier: Apache-2.0

"""`cloudrc new`: write the files of a robot or of a perception of one's own."""

from __future__ import annotations

from pathlib import Path
from shlex import quote

from cloudrc.base.errors import BadInputError
from cloudrc.doors.cli.parser import Options, Parser, add_verbs

VERBS = {
    "robot": "write a folder with a robot that flies, to change",
    "perception": "write a file with a perception that moves the robot by what it sees, to change",
}
EPILOG = """\
examples:
  cloudrc new robot ./my_robot       robot.yaml, robot.xml and a test
  cloudrc robot check ./my_robot
  cloudrc new perception ./my_perception.py             drives by scans
  cloudrc new perception ./my_perception.py --camera    flies by pictures"""


def arguments(parser: Parser) -> None:
    """Declare the command's arguments."""
    robot, perception = add_verbs(parser, VERBS).values()
    robot.add_argument("folder", type=Path, metavar="DIR", help="folder for the files")
    perception.add_argument("file", type=Path, metavar="FILE", help="Python file, NAME.py")
    perception.add_argument(
        "--camera", action="store_true", help="for a robot with a camera, in place of a scanner"
    )


def execute(options: Options) -> None:
    """Write the files, and print what to type next."""
    if options.verb == "perception":
        _write_perception(options.file, camera=options.camera)
        return
    from cloudrc.flight.runs.new_robot import write_robot

    folder = options.folder
    names = write_robot(folder)
    typed = _typed(folder)
    print(
        f"change {', '.join(names)} in {folder}, then:\n"
        f"  cloudrc robot check {typed}\n"
        f"  cloudrc run steps --mode virtual --set world.robot={typed}\n"
        f"  pytest {typed}"
    )


def _write_perception(file: Path, *, camera: bool) -> None:
    from cloudrc.flight.runs.new_perception import write_perception

    if file.suffix != ".py":
        raise BadInputError(f"{file}: name a Python file, such as {file}.py")
    if file.exists():
        raise BadInputError(f"{file}: exists already; name another file")
    write_perception(file, camera=camera)
    experiment, with_it = "follow" if camera else "gap", f"--set cloud.perception={_typed(file)}"
    print(
        f"change see() in {file}, then:\n"
        f"  cloudrc run {experiment} --mode virtual {with_it}\n"
        f"  cloudrc run {experiment} --mode virtual {with_it} --set link.profile=lte"
    )


def _typed(path: Path) -> str:
    """Return a path as it is typed where a name without a folder means a shipped file."""
    return quote(str(path if path.is_absolute() or path.parts[:1] == ("..",) else f"./{path}"))
