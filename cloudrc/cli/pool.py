"""Much work on several cores: results in the order of the work, whichever is done first.

What asks a command to end: a person, a batch system, a terminal, or that its parent is gone.
"""

from __future__ import annotations

import multiprocessing
import os
import signal
import threading
import time
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from itertools import islice
from types import FrameType
from typing import TypeVar

from cloudrc.errors import InvalidRunError

LOOK_PERIOD = 0.5
"""How often a worker looks whether its parent is there [s]."""


def end_orderly() -> None:
    """Take SIGTERM and SIGHUP as Ctrl-C is taken: the command sees a KeyboardInterrupt.

    A SIGHUP that is ignored from the start stays so: that is what `nohup` is for.
    """
    signal.signal(signal.SIGTERM, signal.default_int_handler)
    if signal.getsignal(signal.SIGHUP) is not signal.SIG_IGN:
        signal.signal(signal.SIGHUP, _hung_up)


def _hung_up(number: int, frame: FrameType | None) -> None:
    # The shell and the kernel each send one: the second must not interrupt the report.
    signal.signal(signal.SIGHUP, signal.SIG_IGN)
    raise KeyboardInterrupt


def end_with(parent: int) -> None:
    """In a worker of a pool: end when its parent is gone, which may have been killed.

    Args:
        parent: Process id of who has made the pool.
    """

    def watch() -> None:
        while os.getppid() == parent:
            time.sleep(LOOK_PERIOD)
        os._exit(1)  # there is nobody to tell, and nothing to end

    threading.Thread(target=watch, name="parent", daemon=True).start()


Work = TypeVar("Work")
Result = TypeVar("Result")
AHEAD = 1000
"""Pieces of work in a pool, at most; more than any machine has cores. Given all of a long search at
once, it hangs before Python 3.11.6: each wakes it by a pipe that holds 16,384 (cpython 105829)."""
KILLED = "a worker was killed, by the kernel if memory ran out"


class WorkerDiedError(InvalidRunError):
    """A process of the pool was ended by somebody else."""


def in_order(
    function: Callable[[Work], Result], work: Sequence[Work], jobs: int
) -> Iterator[Result]:
    """Do all of it, some at once. Who stops listening waits for what is under way, no more.

    Args:
        function: Of a module: it is called in other processes.
        work: Its arguments.
        jobs: How many at once; more than there are cores or work would only take memory.

    Yields:
        What the function gives for each.

    Raises:
        WorkerDiedError: If one of the processes was killed.
    """
    workers = min(jobs, len(work), os.cpu_count() or 1)
    if workers <= 1:
        yield from map(function, work)
        return
    fork = multiprocessing.get_context("fork")  # its workers are children of this process
    pool = ProcessPoolExecutor(workers, fork, _begin, (os.getpid(),))
    try:
        # Not `map`: where a worker has died, it cancels what the pool marks as failed just then.
        left = iter(work)
        # Batch by batch: a pool that is broken takes no more, and what it has done is told first.
        while futures := deque(pool.submit(function, each) for each in islice(left, AHEAD)):
            while futures:
                yield futures.popleft().result()
    except KeyboardInterrupt:  # who presses Ctrl-C does not want to wait
        for worker in multiprocessing.active_children():
            worker.kill()  # one that has only begun may still take SIGTERM as Ctrl-C, and lose it
        raise
    except BrokenProcessPool as error:
        raise WorkerDiedError(f"{KILLED}: try fewer '--jobs'") from error
    finally:
        pool.shutdown(cancel_futures=True)


def _begin(first: int) -> None:
    """What a terminal sends reaches all processes: the first one says when the others end."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    signal.signal(signal.SIGHUP, signal.SIG_IGN)
    signal.signal(signal.SIGTERM, signal.SIG_DFL)
    end_with(first)
