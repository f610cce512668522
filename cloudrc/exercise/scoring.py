"""Score a student's files, each part of the task in a process of its own.

So a crash costs the points of this part only. The process is no sandbox: a student's file has all
rights of the user.
"""

from __future__ import annotations

import json
import signal
import subprocess
from collections.abc import Iterator
from pathlib import Path
from tempfile import TemporaryFile
from typing import Any

from cloudrc.config.task import read_task
from cloudrc.drivers.machine import interpreter, signal_group
from cloudrc.errors import to_one_line
from cloudrc.exercise import hand_in
from cloudrc.exercise.files import SHIPPED, describe_missing, task_of
from cloudrc.exercise.score import sum_up

TIME_LIMIT = 60
"""Limit of each part [s] of processor time; the solution needs 5 s."""
PATIENCE = 10
"""Last resort: each part ends after the limit times this number, in real time [1]."""
ROWS_MAX = 64 << 10
"""Largest size of all rows of a part [bytes]."""


def run_part(
    part: str, folder: Path, limit: int, wait: float, source: Path = SHIPPED
) -> tuple[bytes, str]:
    """Score a part in a process; return what it has written, and why it writes no more.

    The process has a session of its own, which ends with it. It has `limit` [s] of processor time,
    and ends after `wait` [s].
    """
    why = "ended the process of the check, or sent something else than its results"
    with TemporaryFile() as rows:
        process = subprocess.Popen(
            interpreter("-m", hand_in.__name__, part, str(folder), str(limit), str(source)),
            start_new_session=True,
            stdin=subprocess.PIPE,
            stdout=rows,
            stderr=subprocess.DEVNULL,
        )
        try:
            if process.wait(wait) == -signal.SIGXCPU:
                why = f"no end after {limit} s of processor time"
        except subprocess.TimeoutExpired:
            why = ""
        finally:
            signal_group(process, signal.SIGKILL)  # nothing of a hand-in runs on
            process.communicate()
        rows.seek(0)
        return rows.read(ROWS_MAX), why


def read_rows(data: bytes) -> list[tuple[float, str]]:
    """Return the points of each test [1] and its result in words, up to what is no row."""
    found = list[tuple[float, str]]()
    for line in data.splitlines():
        try:
            row = json.loads(line)
            found.append((float(row["points"]), str(row["seen"])))
        except (ArithmeticError, ValueError, TypeError, KeyError, RecursionError):
            break
    return found


def check(
    folder: Path, source: Path = SHIPPED, limit: int = TIME_LIMIT, patience: float = PATIENCE
) -> Iterator[dict[str, Any]]:
    """Score the student's files in a folder, each part within `limit` [s] of processor time.

    `source` is the task. Yield one dictionary per test, when its part has ended: the test's name,
    its points, the result in words, and whether the points are valid. They are not if a part took
    `patience` times the limit in real time.
    """
    wait, task = limit * patience, read_task(source)
    for part, about in task.parts.items():
        data, why = run_part(part, folder, limit, wait, source)
        slow = f"too slow here: no end after {wait:g} s; the score is not valid"
        hint = describe_missing(folder, [about.file] if about.file else [])
        rows = iter(read_rows(data))
        for test, asked in about.tests.items():
            points, seen = next(rows, (0.0, f"{about.file or 'a file'}: {why or slow}"))
            yield {
                "part": part,
                "test": test,
                "points": round(min(points, asked.points), 1) if points > 0.0 else 0.0,
                "max_points": asked.points,
                "seen": to_one_line(f"{seen}; {hint}" if hint else seen),
                "valid": bool(why),
            }


def score(source: Path | None, folder: Path) -> dict[str, Any]:
    """Return the score of a hand-in; `source` is the task, None: that of its folder."""
    return sum_up([*check(folder, task_of(folder, source))])
