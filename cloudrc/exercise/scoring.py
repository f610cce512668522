"""Score a student's files, each part of the exercise in a process of its own.

So a crash costs the points of this part only. The process is no sandbox: a student's file has all
rights of the user.
"""

from __future__ import annotations

import json
import os
import select
import signal
import subprocess
import time
from collections.abc import Iterator
from contextlib import closing
from pathlib import Path
from typing import Any

from cloudrc.drivers.children import signal_group
from cloudrc.drivers.machine import interpreter
from cloudrc.errors import to_one_line
from cloudrc.exercise import hand_in
from cloudrc.exercise.files import FILES
from cloudrc.exercise.points import POINTS

TIME_LIMIT = 60
"""Limit of each part [s] of processor time; the solution needs 5 s."""
PATIENCE = 10
"""Last resort: each part ends after the limit times this number, in real time [1]."""
LINE_MAX = 64 << 10
"""Largest size of a row [bytes]."""


class Process:
    """The process that scores one part; it has a session of its own."""

    def __init__(self, part: str, folder: Path, limit: int, patience: float = PATIENCE) -> None:
        """Start the process; it has `limit` [s] of processor time, `patience` times it in all."""
        self.too_slow = False  # the computer, so that the score is not valid
        self._limit, self._wait = limit, limit * patience
        self._until = time.monotonic() + self._wait
        self._unread = b""
        self._process = subprocess.Popen(
            interpreter("-m", hand_in.__name__, part, str(folder), str(limit)),
            start_new_session=True,
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.DEVNULL,
        )

    def read_row(self) -> tuple[Any, str]:
        """Return the row of the next test, or None and why there is none."""
        try:
            row = json.loads(self._read_line())
            return {**row, "points": float(row["points"]), "seen": str(row["seen"])}, ""
        except TimeoutError:
            self.too_slow = True
            why = f"too slow here: no end after {self._wait:g} s; the score is not valid"
        except (OSError, EOFError):
            why = "ended the process of the check"
        except (ArithmeticError, ValueError, TypeError, KeyError, RecursionError):
            why = "sent something else than its results"
        self.close()  # nothing of a lost hand-in runs on
        if self._process.returncode == -signal.SIGXCPU:
            why = f"no end after {self._limit} s of processor time"
        return None, why

    def _read_line(self) -> bytes:
        assert self._process.stdout is not None
        rows = self._process.stdout.fileno()
        while b"\n" not in self._unread:
            left = self._until - time.monotonic()
            if left <= 0.0:
                raise TimeoutError
            if select.select([rows], [], [], min(left, 0.2))[0]:
                data = os.read(rows, LINE_MAX)
                self._unread += data
                if not data:
                    raise EOFError
            elif self._process.poll() is not None:  # a child keeps the pipe open
                raise EOFError
            if len(self._unread) > LINE_MAX:
                raise ValueError("a long line")
        line, _, self._unread = self._unread.partition(b"\n")
        return line

    def close(self) -> None:
        """Kill the process and all others of its session's process group."""
        signal_group(self._process, signal.SIGKILL)
        self._process.wait()
        for stream in (self._process.stdin, self._process.stdout):
            if stream is not None:
                stream.close()


def check(
    folder: Path, limit: int = TIME_LIMIT, patience: float = PATIENCE
) -> Iterator[dict[str, Any]]:
    """Score the student's files in a folder, each part within `limit` [s] of processor time.

    Yield one dictionary per test, as it ends: the test's name, its points, the result in words, and
    whether the points are valid. They are not if a part took `patience` times the limit in real
    time.
    """
    for part, tests in POINTS.items():
        with closing(Process(part, folder, limit, patience)) as process:
            lost = ""
            for test, most in tests.items():
                row, lost = (None, lost) if lost else process.read_row()
                seen = row["seen"] if row else f"{FILES.get(part, 'a file')}: {lost}"
                points = row["points"] if row else 0.0
                yield {
                    "part": part,
                    "test": test,
                    "points": round(min(points, most), 1) if points > 0.0 else 0.0,
                    "max_points": most,
                    "seen": to_one_line(seen),
                    "valid": not process.too_slow,
                }
