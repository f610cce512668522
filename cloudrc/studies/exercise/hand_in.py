# SPDX-License-Identifier: Apache-2.0

"""Score one part of a hand-in, in a process of its own: `python -m ... PART DIR TASK LIMITS`.

Each test is a line of JSON on the process's stdout; what the student's files print goes nowhere. If
the part breaks a limit, stderr gets two lines: where the student's file was, and which limit. DIR
is "" for cloudrc's own parts. The reader (`scoring`) bounds the points and the real time.
"""

from __future__ import annotations

import json
import os
import resource
import signal
import sys
from pathlib import Path
from types import FrameType

from cloudrc.studies.exercise import watch

NICENESS = 10
"""Lower priority of a part, so that the process that watches gets its turn, and the machine too."""


def score(part: str, folder: Path | None, source: Path, limits: watch.Limits) -> None:
    """Print a row per test of a part, as it ends; work in the hand-in's folder."""
    rows, notes = (os.fdopen(os.dup(number), "w", encoding="utf-8") for number in (1, 2))
    nowhere = os.open(os.devnull, os.O_RDWR)
    for standard in (0, 1, 2):
        os.dup2(nowhere, standard)
    from cloudrc.config.task import read_task
    from cloudrc.studies.exercise import checks

    def end(number: int, frame: FrameType | None) -> None:
        """End this process, and say which line of the student's files it was at."""
        _, hard = resource.getrlimit(resource.RLIMIT_DATA)
        resource.setrlimit(resource.RLIMIT_DATA, (hard, hard))  # to look takes memory, too
        if folder and frame:
            notes.write(checks.place_of_frame(frame, folder))
            notes.flush()
        signal.signal(number, signal.SIG_DFL)
        os.kill(os.getpid(), number)

    # Of a loop in C, which runs no handler, the kernel ends the process one second later.
    signal.signal(signal.SIGXCPU, end)
    resource.setrlimit(resource.RLIMIT_CPU, (limits.seconds, limits.seconds + 1))
    task = read_task(source)
    if folder:
        os.chdir(folder)  # a file may open one beside it by its name
    watch.limit_memory(limits.memory)
    for row in checks.run(task, part, folder, source.parent, limits.memory_text):
        rows.write(f"{json.dumps(row)}\n")
        rows.flush()


def main(part: str, folder: str, source: str, limits: str) -> None:
    """Score a part in a child process, watch it, and end it with all its children.

    The process that watches is another one, because a student's loop in C lets no other thread run.
    It ends the part, too, when the check closes its end of stdin, as SIGKILL does.
    """
    bounds = watch.Limits(*json.loads(limits))
    watch.adopt()
    worker = os.fork()
    if not worker:
        os.nice(NICENESS)
        score(part, Path(folder) if folder else None, Path(source), bounds)
        os._exit(0)  # the student's files may have started threads
    why = watch.watch(worker, bounds)
    watch.end(worker)
    os.write(2, f"\n{why}".encode())
    os.killpg(0, signal.SIGKILL)  # where a system does not show all children


if __name__ == "__main__":
    main(*sys.argv[1:])
