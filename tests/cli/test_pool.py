"""Work on several cores: order, number of processes, killed workers, Ctrl-C."""

from __future__ import annotations

import multiprocessing
import os
import signal
import time
from collections.abc import Iterator

import pytest

from cloudrc.cli.pool import BATCH_MAX, WorkerDiedError, map_in_order

KILLED = 5
"""The piece of work, or seed, that kills its process."""


@pytest.fixture(autouse=True)
def two_cores(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(os, "cpu_count", lambda: 2)


def _slow_first(number: int) -> int:
    time.sleep(0.2 * (number == 0))
    return number


def _process_id(number: int) -> int:
    return os.getpid()


def _kill_at_five(number: int) -> int:
    if number == KILLED:
        os.kill(os.getpid(), signal.SIGKILL)
    return number


def test_results_have_the_order_of_the_work() -> None:
    assert list(map_in_order(_slow_first, range(6), 2)) == list(range(6))


class _CountingWork(list[int]):
    """Work that counts how much of it has been taken."""

    taken = 0

    def __iter__(self) -> Iterator[int]:
        for each in super().__iter__():
            self.taken += 1
            yield each


def test_much_work_is_submitted_in_batches() -> None:
    work = _CountingWork(range(3 * BATCH_MAX))
    done = map_in_order(_process_id, work, 2)
    next(done)
    assert work.taken == BATCH_MAX
    assert sum(1 for _ in done) == 3 * BATCH_MAX - 1


def test_there_are_no_more_processes_than_cores() -> None:
    done = map_in_order(_process_id, range(6), 100_000)
    pids = {next(done)}
    assert len(multiprocessing.active_children()) == 2
    assert os.getpid() not in pids.union(done)
    assert multiprocessing.active_children() == []


@pytest.mark.parametrize(("pieces", "jobs"), [(1, 100_000), (6, 1), (0, 2)])
def test_work_for_one_process_runs_in_this_one(pieces: int, jobs: int) -> None:
    assert list(map_in_order(_process_id, range(pieces), jobs)) == [os.getpid()] * pieces


def test_a_killed_worker_is_an_error() -> None:
    with pytest.raises(WorkerDiedError, match=r"a worker was killed.*fewer '--jobs'"):
        list(map_in_order(_kill_at_five, range(9), 2))
    assert multiprocessing.active_children() == []


def _slowly(done: Iterator[int]) -> Iterator[int]:
    """Take results more slowly than the workers produce them."""
    for each in done:
        yield each
        time.sleep(0.1)


def test_results_before_a_worker_was_killed_are_kept(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("cloudrc.cli.pool.BATCH_MAX", KILLED)
    results: list[int] = []
    with pytest.raises(WorkerDiedError):
        results.extend(_slowly(map_in_order(_kill_at_five, range(9), 2)))
    assert results[:KILLED] == list(range(KILLED))


def test_ctrl_c_ends_the_workers_at_once() -> None:
    started = time.monotonic()
    done = map_in_order(time.sleep, [0.0, 60.0, 60.0], 2)
    next(done)
    with pytest.raises(KeyboardInterrupt):
        done.throw(KeyboardInterrupt)
    assert time.monotonic() - started < 30.0
    assert multiprocessing.active_children() == []
