"""`cloudrc class`: hand out and score the exercise of docs/exercise.md.

Each part of the exercise runs in its own process, so that a crash costs the points of this part
only. The process is no sandbox: a student's file has all rights of the user.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import time
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from cloudrc.cli.extras import require
from cloudrc.cli.interrupts import interrupt_on_signals
from cloudrc.cli.output import format_document, print_or_drop, print_result, table
from cloudrc.cli.parser import add_verbs
from cloudrc.errors import BadInputError

TIME_LIMIT = 120.0
"""Time limit of all parts together [s]; the solution needs 5 s."""
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
    require("a check", ("world",))
    interrupt_on_signals()
    rows = check(options.folder.resolve())
    score, of = (round(sum(row[key] for row in rows), 1) for key in ("points", "max_points"))
    if options.output == "gradescope":
        names = {"points": "score", "max_points": "max_score", "seen": "output"}
        tests = [
            {"name": f"{row['part']}: {row['test']}", "visibility": "visible"}
            | {name: row[key] for key, name in names.items()}
            for row in rows
        ]
        results = {"score": score, "visibility": "visible", "tests": tests}
        print_result("table", {}, format_document(results, "json"))  # no schemaVersion
        return 0
    cells = [("part", "test", "points", "seen")]
    cells += [(r["part"], r["test"], f"{r['points']:g}/{r['max_points']}", r["seen"]) for r in rows]
    text = f"{table(cells, right=(2,))}\n\nscore {score:g} of {of}"
    print_result(options.output, {"score": score, "max_score": of, "checks": rows}, text)
    return 0


def _new(folder: Path) -> int:
    from cloudrc.exercise import checks

    names = [file for file, *_ in checks.PARTS.values()]
    if there := [name for name in names if (folder / name).exists()]:
        raise BadInputError(f"{folder / there[0]}: exists and stays as it is; name another folder")
    folder.mkdir(parents=True, exist_ok=True)
    for name in names:
        (folder / name).write_bytes(Path(checks.__file__).with_name(name).read_bytes())
    print_or_drop(f"fill in {', '.join(names)} in {folder}, then: cloudrc class check {folder}")
    return 0


def check(folder: Path, limit: float = TIME_LIMIT) -> list[dict[str, Any]]:
    """Score the student's files in a folder within `limit` [s].

    Return one dictionary per test, with the test's name, its points and the result in words.
    """
    from cloudrc.drivers.machine import interpreter
    from cloudrc.exercise import checks

    found, deadline = list[dict[str, Any]](), time.monotonic() + limit
    processes: dict[str, subprocess.Popen[bytes]] = {}
    silent: dict[str, Any] = dict.fromkeys(("stdin", "stdout", "stderr"), subprocess.DEVNULL)
    with TemporaryDirectory() as answers:
        try:
            for part in checks.CHECKS:
                words = "-m", checks.__name__, part, str(folder), f"{answers}/{part}"
                processes[part] = subprocess.Popen(
                    interpreter(*words), start_new_session=True, **silent
                )
            for part, process in processes.items():
                why = "ended the process of the check"
                try:
                    process.wait(max(deadline - time.monotonic(), 0.0))
                except subprocess.TimeoutExpired:
                    why = f"no end after {limit:g} s"
                answer = Path(answers, part)
                if answer.exists():
                    found += json.loads(answer.read_bytes())
                else:
                    file = checks.PARTS.get(part, ("a file",))[0]
                    lost = [(0.0, f"{file}: {why}")] * len(checks.CHECKS[part])
                    found += checks.rows(part, lost)
        finally:
            for process in processes.values():
                process.kill()
                process.wait()
    return found
