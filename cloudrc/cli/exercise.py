"""`cloudrc class`: hand out and score the exercise of docs/exercise.md.

The students' functions run in a process of their own for each part of the exercise, so that a crash
costs the points of this part only. The process is no sandbox: a student's file has all rights of
the user.
"""

from __future__ import annotations

import argparse
import sys
from contextlib import ExitStack
from pathlib import Path

from cloudrc.cli.output import format_document, print_or_drop, print_result
from cloudrc.cli.parser import add_verbs
from cloudrc.errors import BadInputError
from cloudrc.files import write_atomically
from cloudrc.runs.interrupts import interrupt_on_signals
from cloudrc.runs.requirements import require
from cloudrc.text import escape, table

NOT_VALID = (
    "not valid: a part took too long; check again with less load, or look for a file that waits"
)
"""Mark of a score."""
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
    if options.verb == "new":
        return _new(options.folder)
    if not options.folder.is_dir():
        raise BadInputError(f"{options.folder}: no such folder; 'cloudrc class new' makes one")
    _refuse_other_folder(options)
    require("a check", ("world",))
    interrupt_on_signals()
    print_or_drop(escape(f"scores {options.folder}"), sys.stderr)
    from cloudrc.exercise.scoring import check

    rows = []
    for row in check(options.folder.resolve()):
        rows.append(row)
        text = f"  {row['part']}, {row['test']}: {row['points']:g}/{row['max_points']}"
        print_or_drop(text, sys.stderr)
    score, of = (round(sum(row[key] for row in rows), 1) for key in ("points", "max_points"))
    valid = all(row["valid"] for row in rows)
    if options.output == "gradescope":
        names = {"points": "score", "max_points": "max_score", "seen": "output"}
        tests = [
            {"name": f"{row['part']}: {row['test']}", "visibility": "visible"}
            | {name: row[key] for key, name in names.items()}
            for row in rows
        ]
        results = {"score": score, "visibility": "visible", "tests": tests}
        if not valid:
            results["output"] = NOT_VALID
        print_result("table", {}, format_document(results, "json"))  # no schemaVersion
        return 0
    cells = [("part", "test", "points", "seen")]
    cells += [(r["part"], r["test"], f"{r['points']:g}/{r['max_points']}", r["seen"]) for r in rows]
    text = f"{table(cells, right=(2,))}\n\nscore {score:g} of {of}"
    if not valid:
        text += f"\n{NOT_VALID}"
    document = {"score": score, "max_score": of, "valid": valid, "checks": rows}
    print_result(options.output, document, text)
    return 0


def _refuse_other_folder(options: argparse.Namespace) -> None:
    """Raise a BadInputError if a folder has none of the files, except for a hand-in at Gradescope.

    Gradescope shows results only, so that a hand-in without the files has to get 0 points there.
    """
    from cloudrc.exercise.hand_in import FILES

    names = FILES.values()
    if options.output != "gradescope" and not any((options.folder / n).exists() for n in names):
        text = f"has none of {', '.join(names)}; name the folder that 'cloudrc class new' made"
        raise BadInputError(f"{options.folder}: {text}")


def _new(folder: Path) -> int:
    from cloudrc.exercise import hand_in

    names = [*hand_in.FILES.values()]
    if there := [name for name in names if (folder / name).exists()]:
        raise BadInputError(f"{folder / there[0]}: exists and stays as it is; name another folder")
    folder.mkdir(parents=True, exist_ok=True)
    with ExitStack() as undo:  # without all files, leave none: the next try would be refused
        for name in names:
            write_atomically(folder / name, Path(hand_in.__file__).with_name(name).read_bytes())
            undo.callback((folder / name).unlink)
        undo.pop_all()
    print_or_drop(f"fill in {', '.join(names)} in {folder}, then: cloudrc class check {folder}")
    return 0
