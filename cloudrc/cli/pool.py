"""Much work on several cores: results in the order of the work, whichever is done first."""

from __future__ import annotations

import multiprocessing
import os
import signal
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from itertools import islice
from typing import TypeVar

from cloudrc.cli.signals import end_with
from cloudrc.errors import InvalidRunError

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
