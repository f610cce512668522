"""`cloudrc class`: hand out and score the exercise of docs/exercise.md.

Each part runs in a process of its own, so that a failure costs the points of this part only. That
is no sandbox: a student's file has all rights of the user.
"""

from __future__ import annotations

import argparse
import json
import multiprocessing
import os
import resource
import signal
import time
from contextlib import suppress
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any, NoReturn

from cloudrc.cli.output import format_document, print_or_drop, table
from cloudrc.cli.pool import interrupt_on_signals, isolated_start
from cloudrc.errors import BadInputError

PROCESSOR_TIME, TIME = 20, 300
"""Limits of a part: processor time and real time [s]; the solution needs 2 s."""
FORMS = ("table", "json", "yaml", "gradescope")
EPILOG = """\
examples:
  cloudrc class new exercise        three files to fill in
  cloudrc class check exercise      the points of each part
  cloudrc class check /autograder/submission -o gradescope > results.json

'check' runs the files in DIR with all your rights; it is no sandbox."""


def arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the command's arguments."""
    verbs = parser.add_subparsers(dest="verb", required=True, metavar="VERB")
    new = verbs.add_parser("new", help="write the files that students fill in")
    new.add_argument("folder", type=Path, metavar="DIR", help="folder for the files")
    check = verbs.add_parser("check", help="score a student's files")
    check.add_argument("folder", type=Path, metavar="DIR", help="folder with the files")
    about = "output format (default: table)"
    check.add_argument("-o", "--output", choices=FORMS, default="table", help=about)


def execute(options: argparse.Namespace) -> int:
    """Write the files, or score them; the exit code does not depend on the score."""
    if options.verb == "new":
        return _new(options.folder)
    if not options.folder.is_dir():
        raise BadInputError(f"{options.folder}: no such folder; 'cloudrc class new' makes one")
    interrupt_on_signals()
    rows = check(options.folder.resolve())
    score, of = (round(sum(row[key] for row in rows), 1) for key in ("points", "max_points"))
    if options.output == "table":
        cells = [
            (r["part"], r["test"], f"{r['points']:g}/{r['max_points']}", r["seen"]) for r in rows
        ]
        lines = table([("part", "test", "points", "seen"), *cells], right=(2,))
        print_or_drop(f"{lines}\n\nscore {score:g} of {of}")
        return 0
    document = {"schemaVersion": 1, "score": score, "max_score": of, "checks": rows}
    if options.output == "gradescope":
        tests = [
            {
                **{"name": f"{row['part']}: {row['test']}", "output": row["seen"]},
                **{"score": row["points"], "max_score": row["max_points"], "visibility": "visible"},
            }
            for row in rows
        ]
        document = {"score": score, "visibility": "visible", "tests": tests}
    print_or_drop(format_document(document, options.output.replace("gradescope", "json")))
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


def check(folder: Path, limit: float = PROCESSOR_TIME) -> list[dict[str, Any]]:
    """Run all parts at the same time, each for `limit` [s] at most; return the rows of all."""
    from cloudrc.exercise import checks

    context, started, rows = multiprocessing.get_context("spawn"), [], list[dict[str, Any]]()
    deadline = time.monotonic() + TIME
    try:
        for part in checks.CHECKS:
            reader, writer = context.Pipe(duplex=False)
            process = context.Process(target=_run, args=(part, folder, limit, writer))
            with isolated_start():
                process.start()
            writer.close()
            started.append((part, process, reader))
        for part, _, reader in started:
            name = checks.PARTS.get(part, ("a file",))[0]
            why = f"{name}: no end after {TIME} s"
            with suppress(EOFError):  # the process has ended without an answer
                if reader.poll(max(0.0, deadline - time.monotonic())):
                    why = f"{name}: ended the process of the check"
                    rows += json.loads(reader.recv_bytes())
                    continue
            rows += checks.rows(part, [(0.0, why)] * len(checks.CHECKS[part]))
    finally:
        for _, process, _ in started:
            process.kill()
    return rows


def _run(part: str, folder: Path, limit: float, writer: Connection) -> NoReturn:
    """Check a part in this process, within the limits, and send its rows."""

    def expire(*_: object) -> NoReturn:  # the only exception that a flight does not catch
        raise KeyboardInterrupt(f"no end after {limit:g} s of processor time")

    null = os.open(os.devnull, os.O_RDWR)
    for stream in range(3):  # the files may print
        os.dup2(null, stream)
    with suppress(ValueError):  # the limit is lower already
        resource.setrlimit(resource.RLIMIT_DATA, (4 << 30, 4 << 30))  # [bytes]
    signal.signal(signal.SIGPROF, expire)
    signal.setitimer(signal.ITIMER_PROF, limit, 1.0)  # again, if a file catches it
    from cloudrc.exercise import checks

    writer.send_bytes(json.dumps(checks.run(part, folder)).encode())
    os._exit(0)  # the files may have started threads
