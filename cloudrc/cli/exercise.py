"""`cloudrc class`: hand out and score the exercise of docs/exercise.md.

The students' functions run in a process of their own for each part of the exercise, so that a crash
costs the points of this part only. The process is no sandbox: a student's file has all rights of
the user.
"""

from __future__ import annotations

import argparse
from contextlib import closing
from pathlib import Path
from shlex import quote

from cloudrc.cli.output import format_document, print_or_drop, print_result
from cloudrc.cli.parser import add_verbs
from cloudrc.errors import BadInputError
from cloudrc.outside.paths import check_there
from cloudrc.runs.interrupts import interrupt_on_signals
from cloudrc.runs.requirements import require
from cloudrc.text import escape

VERBS = {"new": "write the files that students fill in", "check": "score a student's files"}
FORMS = ("table", "json", "yaml", "gradescope")
EPILOG = """\
examples:
  cloudrc class new exercise        three files to fill in
  cloudrc class check exercise      the points of each part
  cloudrc class check /autograder/submission -o gradescope > results.json

'check' runs the files in DIR with all your rights; it is no sandbox."""


def arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the command's arguments."""
    new, check = add_verbs(parser, VERBS).values()
    new.add_argument("folder", type=Path, metavar="DIR", help="folder for the files")
    check.add_argument("folder", type=Path, metavar="DIR", help="folder with the files")
    about = "output format (default: table)"
    check.add_argument("-o", "--output", choices=FORMS, default="table", help=about)


def execute(options: argparse.Namespace) -> int:
    """Write a student's files, or score the files in a folder; return 0 whatever the score."""
    from cloudrc.exercise.files import write_files

    folder: Path = options.folder
    if options.verb == "new":
        names = write_files(folder)
        command = f"cloudrc class check {quote(str(folder))}"
        print_or_drop(f"fill in {', '.join(names)} in {folder}, then: {command}")
        return 0
    for_gradescope = options.output == "gradescope"
    _check_folder(folder, may_be_empty=for_gradescope)
    require("a check", ("world",))
    interrupt_on_signals()
    from cloudrc.cli.progress import Progress
    from cloudrc.exercise import score
    from cloudrc.exercise.scoring import check

    rows = []
    with closing(Progress(f"scores {folder}")) as view:
        view.say(escape(f"scores {folder}"))
        for row in check(folder.resolve()):
            rows.append(row)
            view.say(f"  {row['part']}, {row['test']}: {row['points']:g}/{row['max_points']}")
    result = score.sum_up(rows)
    if for_gradescope:  # without schemaVersion
        print_result("table", {}, format_document(score.for_gradescope(result), "json"))
    else:
        print_result(options.output, result, score.as_text(result))
    return 0


def _check_folder(folder: Path, *, may_be_empty: bool) -> None:
    """Check that a folder has files of a student.

    With `may_be_empty` it may have none, so that a hand-in without the files gets 0 points.
    """
    from cloudrc.exercise.files import FILES

    if folder.is_file():
        text = "is a file; if it is an archive, unpack it, and name the folder with the files"
        raise BadInputError(f"{folder}: {text}")
    check_there(folder, "'cloudrc class new' makes one")
    names = FILES.values()
    if not may_be_empty and not any((folder / name).exists() for name in names):
        text = f"has none of {', '.join(names)}; name the folder that 'cloudrc class new' made"
        raise BadInputError(f"{folder}: {text}")
