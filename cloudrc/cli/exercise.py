"""`cloudrc class`: hand out and score the exercise of docs/exercise.md.

The students' functions run in a process of their own for each part of the exercise, so that a crash
costs the points of this part only. The process is no sandbox: a student's file has all rights of
the user.
"""

from __future__ import annotations

import argparse
import json
import os
import select
import signal
import subprocess
import sys
import time
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, closing, suppress
from pathlib import Path
from typing import Any

from cloudrc.cli.output import format_document, print_or_drop, print_result
from cloudrc.cli.parser import add_verbs
from cloudrc.errors import BadInputError
from cloudrc.files import write_atomically
from cloudrc.runs.interrupts import interrupt_on_signals
from cloudrc.runs.requirements import require
from cloudrc.text import escape, table

TIME_LIMIT = 60
"""Limit of each part [s] of processor time; the solution needs 2 s."""
PATIENCE = 10
"""Last resort: each part ends after the limit times this number, in real time [1]."""
ANSWER_MAX = 64 << 10
"""Largest size of an answer from the process of a hand-in [bytes]."""
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


class Process:
    """The process in which a student's functions run; it has a session of its own."""

    def __init__(self, folder: Path, limit: int, patience: float = PATIENCE) -> None:
        """Start the process; it has `limit` [s] of processor time.

        It has `limit` times `patience` [1] of real time.
        """
        from cloudrc.drivers.machine import interpreter
        from cloudrc.exercise import hand_in

        self.too_slow = False  # the computer, so that the score is not valid
        self._limit, self._wait = limit, limit * patience
        self._until = time.monotonic() + self._wait
        self._unread, self._number, self._lost = b"", 0, ""
        pipe, nowhere = subprocess.PIPE, subprocess.DEVNULL
        self._process = subprocess.Popen(
            interpreter("-m", hand_in.__name__, str(folder), str(limit)),
            start_new_session=True,
            stdin=pipe,
            stdout=pipe,
            stderr=nowhere,
        )

    def ask(self, calls: Sequence[Any]) -> tuple[Any, str]:
        """Send calls to the process; return the result of the last one, and an error or "".

        Raises:
            HandInError: If the process has ended, is too slow, or sends no answer.
        """
        from cloudrc.exercise.remote import HandInError

        if not self._lost:
            try:
                return self._ask(calls)
            except TimeoutError:
                self.too_slow = True
                why = f"too slow here: no end after {self._wait:g} s; the score is not valid"
            except (OSError, EOFError):
                why = "ended the process of the check"
            except (ValueError, TypeError, RecursionError):
                why = "sent something else than its results"
            self.close()  # nothing of a lost hand-in runs on
            if self._process.returncode == -signal.SIGXCPU:
                why = f"no end after {self._limit} s of processor time"
            self._lost = f"{_files_of(calls)}: {why}"
        raise HandInError(self._lost)

    def _ask(self, calls: Sequence[Any]) -> tuple[Any, str]:
        assert self._process.stdin is not None
        self._number += 1
        self._process.stdin.write(json.dumps([self._number, calls]).encode() + b"\n")
        self._process.stdin.flush()
        number, result, error = json.loads(self._read_line())
        if number != self._number or not isinstance(error, str):
            raise ValueError("another answer")
        return result, error

    def _read_line(self) -> bytes:
        assert self._process.stdout is not None
        answers = self._process.stdout.fileno()
        while b"\n" not in self._unread:
            left = self._until - time.monotonic()
            if left <= 0.0:
                raise TimeoutError
            if select.select([answers], [], [], min(left, 0.2))[0]:
                data = os.read(answers, ANSWER_MAX)
                self._unread += data
                if not data:
                    raise EOFError
            elif self._process.poll() is not None:  # a child keeps the pipe open
                raise EOFError
            if len(self._unread) > ANSWER_MAX:
                raise ValueError("a long answer")
        line, _, self._unread = self._unread.partition(b"\n")
        return line

    def close(self) -> None:
        """Kill the process and all others of its session's process group."""
        with suppress(ProcessLookupError, PermissionError):
            os.killpg(self._process.pid, signal.SIGKILL)
        self._process.wait()
        for pipe in (self._process.stdin, self._process.stdout):
            with suppress(OSError):
                if pipe is not None:
                    pipe.close()


def _files_of(calls: Sequence[Any]) -> str:
    """Return the names of the student's files that calls concern."""
    from cloudrc.exercise.hand_in import FILES

    parts = {name.partition(" ")[0] for name, *_ in calls}
    return " or ".join(file for part, file in FILES.items() if part in parts)


def check(
    folder: Path, limit: int = TIME_LIMIT, patience: float = PATIENCE
) -> Iterator[dict[str, Any]]:
    """Score the student's files in a folder, each part within `limit` [s] of processor time.

    Yield one dictionary per test, as it ends: the test's name, its points, the result in words, and
    whether the points are valid. They are not if a part took `patience` times the limit in real
    time.
    """
    from cloudrc.exercise import checks
    from cloudrc.exercise.remote import Remote

    for part in checks.CHECKS:
        with closing(Process(folder, limit, patience)) as process:
            for row in checks.run(part, Remote(process.ask), folder):
                yield {**row, "valid": not process.too_slow}
