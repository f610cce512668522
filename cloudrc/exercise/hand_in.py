"""Score one part of a hand-in, in a process of its own: `python -m ... PART DIR LIMIT TASK`.

Each test is a line of JSON on the process's stdout; what the student's files print goes nowhere.
The reader (`scoring`) bounds the points and the time.
"""

from __future__ import annotations

import json
import os
import resource
import select
import signal
import sys
from pathlib import Path


def end_with_check() -> None:
    """Start a process that kills this process group as soon as the check closes its end of stdin.

    SIGKILL closes it, too. The process is another one, because a student's loop in C lets no other
    thread run.
    """
    if os.fork():
        return
    os.close(1)  # the rows end with the process of the student's files
    check = select.poll()
    check.register(0, 0)  # an end that closes is always reported
    check.poll()
    os.killpg(0, signal.SIGKILL)


def score(part: str, folder: Path, source: Path) -> None:
    """Print a row per test of a part, as it ends; work in the hand-in's folder."""
    rows = os.fdopen(os.dup(1), "w", encoding="utf-8")
    nowhere = os.open(os.devnull, os.O_RDWR)
    for standard in (0, 1, 2):
        os.dup2(nowhere, standard)
    from cloudrc.config.task import read_task
    from cloudrc.exercise import checks

    task = read_task(source)
    os.chdir(folder)  # a file may open one beside it by its name
    for row in checks.run(task, part, folder, source.parent):
        rows.write(f"{json.dumps(row)}\n")
        rows.flush()


if __name__ == "__main__":
    end_with_check()
    limit = int(sys.argv[3])  # of processor time [s]: SIGXCPU or, if blocked, SIGKILL
    resource.setrlimit(resource.RLIMIT_CPU, (limit, limit + 1))
    score(sys.argv[1], Path(sys.argv[2]), Path(sys.argv[4]))
    os._exit(0)  # the student's files may have started threads
