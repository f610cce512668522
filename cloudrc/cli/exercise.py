"""`cloudrc class`: hand out and score the exercise of docs/exercise.md.

The students' functions run in a process of their own for each part of the exercise, so that a crash
costs the points of this part only. The process is no sandbox: a student's file has all rights of
the user.
"""

from __future__ import annotations

from pathlib import Path
from shlex import quote

from cloudrc.cli.output import format_document, output_argument, print_line, print_result
from cloudrc.cli.parser import Options, Parser, add_verbs, flags
from cloudrc.errors import BadInputError
from cloudrc.outside.paths import check_there

VERBS = {"new": "write the files that students fill in", "check": "score a student's files"}
EPILOG = """\
examples:
  cloudrc class new exercise        three files to fill in
  cloudrc class check exercise      the points of each part
  cloudrc class check /autograder/submission -o gradescope > results.json

'check' runs the files in DIR with all your rights; it is no sandbox."""


def arguments(parser: Parser) -> None:
    """Declare the command's arguments."""
    new, check = add_verbs(parser, VERBS).values()
    flags(new)("folder", "DIR", "folder for the files")
    flags(check)("folder", "DIR", "folder with the files")
    output_argument(check, forms=("gradescope",))


def execute(options: Options) -> None:
    """Write a student's files, or score the files in a folder; return 0 whatever the score."""
    from cloudrc.exercise.files import write_files

    folder: Path = options.folder
    if options.verb == "new":
        names = write_files(folder)
        command = f"cloudrc class check {quote(str(folder))}"
        print_line(f"fill in {', '.join(names)} in {folder}, then: {command}")
        return
    check_there(folder, "'cloudrc class new' makes one")
    if options.output != "gradescope":  # there, a hand-in without the files gets 0 points
        _check_files(folder)
    from cloudrc.cli.progress import Progress
    from cloudrc.exercise import score
    from cloudrc.exercise.scoring import check

    rows = []
    with Progress(f"scores {folder}") as view:
        view.say(f"scores {folder}")
        for row in check(folder.resolve()):
            rows.append(row)
            view.say(f"  {row['part']}, {row['test']}: {row['points']:g}/{row['max_points']}")
    result = score.sum_up(rows)
    forms = {"gradescope": format_document(score.for_gradescope(result), "json")}
    print_result(options.output, result, score.as_text(result), **forms)


def _check_files(folder: Path) -> None:
    """Check that a folder has files of a student."""
    from cloudrc.exercise.files import FILES

    names = FILES.values()
    if not any((folder / name).exists() for name in names):
        text = f"has none of {', '.join(names)}; name the folder that 'cloudrc class new' made"
        raise BadInputError(f"{folder}: {text}")
