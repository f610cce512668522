"""Work on several cores: order, number of processes, killed workers, Ctrl-C."""

import multiprocessing
import os
import signal
import time

import pytest

from cloudrc.cli.pool import WorkerDiedError, map_in_order

KILLED = 5
"""The piece of work that kills its process."""


@pytest.fixture(autouse=True)
def two_cores(monkeypatch):
    monkeypatch.setattr(os, "cpu_count", lambda: 2)
    yield
    assert multiprocessing.active_children() == []


def _slow_first(number):
    time.sleep(0.2 * (number == 0))
    return number, os.getpid()


def _kill_at_five(number):
    if number == KILLED:
        time.sleep(0.5)  # until the other process has done the rest
        os.kill(os.getpid(), signal.SIGKILL)
    return number


@pytest.mark.parametrize(("pieces", "jobs", "workers"), [(6, 100_000, 2), (1, 9, 0), (6, 1, 0)])
def test_results_keep_the_order_of_the_work(pieces, jobs, workers):
    done = map_in_order(_slow_first, range(pieces), jobs)
    first = next(done)
    assert len(multiprocessing.active_children()) == workers
    numbers, pids = zip(first, *done, strict=True)
    assert numbers == tuple(range(pieces))
    assert (os.getpid() in pids) is (workers == 0)
    assert list(map_in_order(_slow_first, [], 2)) == []


def test_results_before_a_worker_was_killed_are_kept():
    results = []
    with pytest.raises(WorkerDiedError, match=r"a worker was killed.*use fewer processes"):
        results.extend(each for each in map_in_order(_kill_at_five, range(9), 2))
    assert results == list(range(KILLED))


def test_ctrl_c_ends_the_workers_at_once():
    started = time.monotonic()
    done = map_in_order(time.sleep, [0.0, 60.0, 60.0], 2)
    next(done)
    with pytest.raises(KeyboardInterrupt):
        done.throw(KeyboardInterrupt)
    assert time.monotonic() - started < 30.0
