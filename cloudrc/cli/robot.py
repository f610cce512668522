"""`cloudrc robot`: check a robot before it flies."""

from __future__ import annotations

import argparse
from pathlib import Path

from cloudrc.cli.output import (
    output_argument,
    print_result,
)
from cloudrc.cli.parser import add_verbs
from cloudrc.errors import BadInputError
from cloudrc.files import PICTURES, refuse_other_file, write_atomically
from cloudrc.runs.requirements import missing, require

VERBS = {"check": "say what a robot is, fly it in virtual time, and say what must change"}
PICTURE = "check.png"
"""Name of the picture in the folder of a robot."""
EPILOG = """\
examples:
  cloudrc robot check ./my_robot                 also writes my_robot/check.png
  cloudrc robot check quadrotor.xml --picture quadrotor.svg
  cloudrc robot check rover -o json

exit code 2: something must change"""


def arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the command's arguments."""
    (check,) = add_verbs(parser, VERBS).values()
    about = "a folder with robot.yaml, an .xml file, or the name of a shipped robot"
    check.add_argument("robot", metavar="ROBOT", help=about)
    about = f"picture to write: .png, .svg or .pdf (default: {PICTURE} in a folder of yours)"
    check.add_argument("--picture", type=Path, metavar="FILE", help=about)
    output_argument(check)


def execute(options: argparse.Namespace) -> int:
    """Check the robot; return 0, or 2 if something must change."""
    from cloudrc.config import shipped

    require("a check", ("world",))
    given = options.robot
    is_own = Path(given).is_dir() and (given not in shipped.names("robot") or "/" in given)
    name = shipped.model_path("robot", f"{Path(given).resolve()}" if is_own else given, Path.cwd())
    picture = options.picture or (Path(name) / PICTURE if is_own else None)
    kind = _kind_of(picture)
    from cloudrc.robots.check import check, facts_table

    facts, changes = check(name)
    note = _draw(name, picture, kind, required=options.picture is not None)
    document = {"robot": given, "ok": not changes, "changes": changes, "facts": facts}
    lines = [f"must change: {each}" for each in changes] or ["nothing must change"]
    text = "\n".join([facts_table(facts), "", *lines, *note])
    print_result(options.output, document, text)
    return BadInputError.exit_code if changes else 0


def _kind_of(picture: Path | None) -> str:
    if picture is None:
        return ""
    kind = picture.suffix.removeprefix(".")
    if kind not in PICTURES:
        known = ", ".join(f".{each}" for each in PICTURES)
        raise BadInputError(f"--picture {picture}: no kind of picture; use one of {known}")
    refuse_other_file(picture, PICTURES[kind], flag="--picture")
    return kind


def _draw(name: str, picture: Path | None, kind: str, *, required: bool) -> list[str]:
    """Write the picture of a robot; return lines about it."""
    if picture is None:
        return []
    if not required and missing("report"):
        return ["no picture: cloudrc[report] is not installed"]
    require("a picture", ("report",))
    from cloudrc.report.robot_picture import draw_robot
    from cloudrc.robots.check import read_surfaces

    write_atomically(picture, draw_robot(read_surfaces(name), kind))
    return [f"picture: {picture}"]
