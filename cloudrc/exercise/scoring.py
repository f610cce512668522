"""Score a student's files, whose functions run in a process of their own.

Each part of the exercise has its process, so that a crash costs the points of this part only. The
process is no sandbox: a student's file has all rights of the user.
"""

from __future__ import annotations

import json
import os
import select
import signal
import subprocess
import time
from collections.abc import Iterator, Sequence
from contextlib import closing, suppress
from pathlib import Path
from typing import Any

from cloudrc.drivers.machine import interpreter
from cloudrc.exercise import checks, hand_in
from cloudrc.exercise.hand_in import FILES
from cloudrc.exercise.remote import HandInError, Remote

TIME_LIMIT = 60
"""Limit of each part [s] of processor time; the solution needs 2 s."""
PATIENCE = 10
"""Last resort: each part ends after the limit times this number, in real time [1]."""
ANSWER_MAX = 64 << 10
"""Largest size of an answer from the process of a hand-in [bytes]."""


class Process:
    """The process in which a student's functions run; it has a session of its own."""

    def __init__(self, folder: Path, limit: int, patience: float = PATIENCE) -> None:
        """Start the process; it has `limit` [s] of processor time.

        It has `limit` times `patience` [1] of real time.
        """
        self.too_slow = False  # the computer, so that the score is not valid
        self._limit, self._wait = limit, limit * patience
        self._until = time.monotonic() + self._wait
        self._unread, self._number, self._lost = b"", 0, ""
        channel, nowhere = subprocess.PIPE, subprocess.DEVNULL
        self._process = subprocess.Popen(
            interpreter("-m", hand_in.__name__, str(folder), str(limit)),
            start_new_session=True,
            stdin=channel,
            stdout=channel,
            stderr=nowhere,
        )

    def ask(self, calls: Sequence[Any]) -> tuple[Any, str]:
        """Send calls to the process; return the result of the last one, and an error or "".

        Raises:
            HandInError: If the process has ended, is too slow, or sends no answer.
        """
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
        for stream in (self._process.stdin, self._process.stdout):
            with suppress(OSError):
                if stream is not None:
                    stream.close()


def _files_of(calls: Sequence[Any]) -> str:
    """Return the names of the student's files that calls concern."""
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
    for part in checks.CHECKS:
        with closing(Process(folder, limit, patience)) as process:
            for row in checks.run(part, Remote(process.ask), folder):
                yield {**row, "valid": not process.too_slow}
