# SPDX-License-Identifier: Apache-2.0

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
from typing import Any, NamedTuple

from cloudrc.base.errors import TEXT_MAX, to_one_line
from cloudrc.config.task import read_task
from cloudrc.flight.machine import await_or_kill, interpreter, signal_group
from cloudrc.studies.exercise import hand_in as part_process
from cloudrc.studies.exercise.files import SHIPPED, HandIn, describe_missing
from cloudrc.studies.exercise.score import sum_up
from cloudrc.studies.exercise.watch import LIMITS, Limits

ENDING = 10.0
"""Longest time in which a part and its children end [s]."""
ROWS_MAX = 64 << 10
"""Largest size of all rows of a part [bytes]."""


class PartResult(NamedTuple):
    """What a part's process left."""

    rows: bytes
    """What it has written"""
    place: str
    """FILE:LINE of the student's files where it broke a limit, if Python could say it"""
    why: str
    """Why it wrote no more rows; "" if it took too long in real time"""


def run_part(
    part: str, folder: Path | None, source: Path = SHIPPED, limits: Limits = LIMITS
) -> PartResult:
    """Score a part in a process, which ends with all its children.

    `folder` is None for cloudrc's own parts.
    """
    why = "ended the process of the check, or sent something else than its results"
    words = (part, str(folder or ""), str(source), json.dumps(limits))
    with TemporaryFile() as rows, TemporaryFile() as notes:
        process = subprocess.Popen(
            interpreter("-m", part_process.__name__, *words),
            start_new_session=True,
            stdin=subprocess.PIPE,
            stdout=rows,
            stderr=notes,
        )
        try:
            process.wait(limits.seconds * limits.patience)
        except subprocess.TimeoutExpired:
            why = ""
        finally:
            assert process.stdin is not None
            process.stdin.close()  # nothing of a hand-in runs on
            await_or_kill(process, ENDING)
            signal_group(process, signal.SIGKILL)
        for file in (rows, notes):
            file.seek(0)
        place, _, limit = notes.read(TEXT_MAX).decode(errors="replace").partition("\n")
        return PartResult(rows.read(ROWS_MAX), place, why and (limit or why))


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
    folder: Path | None, source: Path = SHIPPED, limits: Limits = LIMITS, unreadable: str = ""
) -> Iterator[dict[str, Any]]:
    """Score the student's files in a folder, each part within `limits`; None: cloudrc's own parts.

    `source` is the task. Yield one dictionary per test, when its part has ended: the test's name,
    its points, the result in words, and whether the points are valid. They are not if a part took
    too long in real time. Without a file, or if the hand-in is `unreadable`, nothing runs.
    """
    slow = f"too slow here: no end after {limits.seconds * limits.patience:g} s"
    task = read_task(source)
    for part, about in task.parts.items():
        names = [about.file] if about.file else [*task.files.values()]
        why = unreadable or (describe_missing(folder, names) if folder else "")
        ran = PartResult(b"", "", why) if why else run_part(part, folder, source, limits)
        place = ran.place or about.file or "a file"
        if not why:
            why = f"{place}: {ran.why or f'{slow}; the score is not valid'}"
        rows = iter(read_rows(ran.rows))
        for test, asked in about.tests.items():
            points, seen = next(rows, (0.0, why))
            yield {
                "part": part,
                "test": test,
                "points": round(min(points, asked.points), 1) if points > 0.0 else 0.0,
                "max_points": asked.points,
                "seen": to_one_line(seen),
                "valid": bool(ran.why),
            }


def score(hand_in: HandIn, limits: Limits = LIMITS) -> tuple[str, dict[str, Any]]:
    """Return name and score of a hand-in."""
    return hand_in.name, sum_up(
        [*check(hand_in.folder, hand_in.source, limits, hand_in.unreadable)]
    )
