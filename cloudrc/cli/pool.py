"""Much work on several cores: results in the order of the work, whichever is done first."""

from __future__ import annotations

import multiprocessing
import os
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from typing import TypeVar

from cloudrc.cli.signals import end_with
from cloudrc.errors import InvalidRunError

Work = TypeVar("Work")
Result = TypeVar("Result")
KILLED = "a worker was killed, by the kernel if memory ran out"


class WorkerDiedError(InvalidRunError):
    """A process of the pool was ended by somebody else."""


def in_order(
    function: Callable[[Work], Result],
    work: Sequence[Work],
    jobs: int,
    begin: Callable[[int], None] = end_with,
) -> Iterator[Result]:
    """Do all of it, some at once. Who stops listening waits only for what is under way.

    Args:
        function: Of a module: it is called in other processes.
        work: Its arguments.
        jobs: How many at once; more than there are cores or work would only take memory.
        begin: Called first in each process, with the id of this one.

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
    pool = ProcessPoolExecutor(workers, fork, begin, (os.getpid(),))
    try:
        # Not `map`: where a worker has died, it cancels what the pool marks as failed just then.
        futures = deque(pool.submit(function, each) for each in work)
        while futures:
            yield futures.popleft().result()
    except BrokenProcessPool as error:
        raise WorkerDiedError(f"{KILLED}: try fewer '--jobs'") from error
    finally:
        pool.shutdown(cancel_futures=True)
