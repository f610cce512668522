# SPDX-License-Identifier: Apache-2.0

"""Run work in worker processes, which end with this process."""

from __future__ import annotations

import multiprocessing
import os
import signal
import sys
import threading
from collections.abc import Callable, Generator, Iterable, Iterator
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from contextlib import ExitStack, closing, contextmanager
from itertools import chain, islice
from types import ModuleType
from typing import Any, TypeVar

from cloudrc.base.errors import CloudrcError, InterruptedRunError, InvalidRunError, machine_error
from cloudrc.base.outside.reuse import reuse_results
from cloudrc.flight.interrupts import is_interrupted, noted_interrupts, raise_if_interrupted
from cloudrc.flight.machine import usable_cores

Work = TypeVar("Work")
Result = TypeVar("Result")
WINDOW = 200
"""Number of calls that wait for a worker at once."""
PERIOD = 0.1
"""Longest time between a signal and the end of a wait for a worker [s]."""


_of_worker = ExitStack()  # ends with the process


class WorkerDiedError(InvalidRunError):
    """Report that a worker process was killed or ended itself."""


def _start_worker() -> None:
    """Let this worker process end with the parent process, even if SIGKILL ended the parent.

    Until then, it reuses what its calls parse, such as files with computing times.
    """
    _of_worker.enter_context(reuse_results())
    parent = multiprocessing.parent_process()
    assert parent is not None

    def wait() -> None:
        parent.join()
        os._exit(1)  # without clean-up, because no process waits for the result

    threading.Thread(target=wait, daemon=True).start()


@contextmanager
def isolated_start() -> Iterator[None]:
    """Isolate worker processes that start inside the block.

    The workers block SIGINT and SIGHUP, because the parent process ends them. They import no
    module from the working folder: a file there may be somebody else's, and importing runs it.
    They do not run the program of this process again, so that a script needs no
    `if __name__ == "__main__"`.
    """
    # The workers inherit the mask. A signal to this process reaches its handler after the block.
    mask = signal.pthread_sigmask(signal.SIG_BLOCK, (signal.SIGINT, signal.SIGHUP))
    safe_path = os.environ.get("PYTHONSAFEPATH", "")
    os.environ["PYTHONSAFEPATH"] = "1"
    main, sys.modules["__main__"] = sys.modules["__main__"], ModuleType("__main__")
    try:
        yield
    finally:
        sys.modules["__main__"] = main
        os.environ["PYTHONSAFEPATH"] = safe_path  # empty: not set
        signal.pthread_sigmask(signal.SIG_SETMASK, mask)


def map_in_order(
    function: Callable[[Work], Result], work: Iterable[Work], jobs: int, *, in_order: bool = True
) -> Generator[Result]:
    """Call a function on each piece of work, in parallel, and yield the results in order.

    `work` may be endless. With `in_order` False, yield each result once it is ready. At most `jobs`
    worker processes run, and at most one per core. If one worker is enough, this process makes the
    calls itself. The function has to be at module level: a worker imports the function. Ctrl-C or
    closing the generator kills the workers and drops all calls that have not ended. After a signal
    no result is yielded, even if `function` has caught the KeyboardInterrupt.
    """
    rest = iter(work)
    first = [*islice(rest, WINDOW)]
    workers, every = min(jobs, len(first), usable_cores()), chain(first, rest)
    if workers <= 1:
        with reuse_results():  # as a worker does
            for result in map(function, every):
                raise_if_interrupted()
                yield result
        return
    with noted_interrupts():
        yield from _map_in_workers(function, every, workers, in_order)


def _map_in_workers(
    function: Callable[[Work], Result], work: Iterator[Work], workers: int, in_order: bool
) -> Generator[Result]:
    # Spawn, do not fork: libraries may have started threads in this process.
    context = multiprocessing.get_context("spawn")
    with isolated_start():  # starts multiprocessing's resource tracker
        pool = ProcessPoolExecutor(workers, context, _start_worker)
    waiting = list[Future[Result]]()
    try:
        while True:
            with isolated_start():  # submit() starts the workers
                for each in islice(work, WINDOW - len(waiting)):
                    waiting.append(pool.submit(function, each))
            if not waiting:
                return
            looked_at = waiting[:1] if in_order else waiting
            ended = wait(looked_at, PERIOD, return_when=FIRST_COMPLETED).done
            raise_if_interrupted()
            for future in ended:
                waiting.remove(future)
                result = future.result()
                raise_if_interrupted()
                yield result
    except BrokenProcessPool as error:
        text = "a worker has died: it was killed, as where memory ran out, or a plug-in ended it"
        raise WorkerDiedError(f"{text}; use fewer processes") from error
    finally:
        # After Ctrl-C, or if the caller has closed the generator, nobody waits for what runs.
        for worker in multiprocessing.active_children() if waiting else ():
            worker.kill()
        pool.shutdown(cancel_futures=True)


def take_each(
    results: Generator[Result, Any, None], take: Callable[[Result], None]
) -> CloudrcError | None:
    """Call `take` with each result until the work ends or is interrupted.

    Return None. If the work ended early, return the reason instead: an `InterruptedRunError` after
    a signal, or the machine's failure, for example that the disk is full.
    """
    try:
        with closing(results):
            for result in results:
                take(result)
    except KeyboardInterrupt:
        return InterruptedRunError("interrupted")
    except Exception as error:
        if is_interrupted():  # the signal also killed a worker, or a library converted the error
            return InterruptedRunError("interrupted")
        failure = error if isinstance(error, WorkerDiedError) else machine_error(error)
        if failure is None or isinstance(error, BrokenPipeError):
            raise
        return failure
    return None
