# SPDX-License-Identifier: Apache-2.0

"""Work on several cores: order, killed workers, Ctrl-C."""

import multiprocessing
import os
import signal
import time
from functools import partial

import pytest

from cloudrc.base.outside.reuse import reuse
from cloudrc.config.load import load_experiment
from cloudrc.flight.trials.workers import map_in_order, take_each
from tests.conftest import wait_until

KILLED = 5
"""The piece of work at which a worker kills its own process."""


@pytest.fixture(autouse=True)
def two_cores_and_a_terminal(monkeypatch):
    monkeypatch.setattr("cloudrc.flight.trials.workers.usable_cores", lambda: 2)
    signal.signal(signal.SIGHUP, signal.SIG_DFL)  # as in a terminal; tests/conftest.py restores it
    yield
    assert multiprocessing.active_children() == []


def _slow_first(number):
    time.sleep(0.2 * (number == 0))
    return number, os.getpid()


def _look_at(experiment):
    files = experiment.world.files
    return os.getpid(), id(files), id(files.compiled)


def _kill_at_five(folder, number):
    if number == KILLED:
        wait_until((folder / str(KILLED - 1)).exists)
        os.kill(os.getpid(), signal.SIGKILL)
    return number


@pytest.mark.parametrize(("pieces", "jobs", "workers"), [(6, 100_000, 2), (1, 9, 0), (6, 1, 0)])
def test_results_keep_the_order_of_the_work(pieces, jobs, workers, monkeypatch):
    monkeypatch.setattr("cloudrc.flight.trials.workers.WINDOW", 4)
    done = map_in_order(_slow_first, range(pieces), jobs)
    first = next(done)
    assert len(multiprocessing.active_children()) == workers
    numbers, pids = zip(first, *done, strict=True)
    assert numbers == tuple(range(pieces))
    assert (os.getpid() in pids) is (workers == 0)


def _shared(number):
    return reuse("shared", lambda: (number, os.getpid()))


@pytest.mark.parametrize("jobs", [1, 2])
def test_flights_of_a_sweep_share_robot_and_scene_once_a_worker(jobs):
    first = load_experiment("hover", ["world.scene=empty"])
    flights = [first.model_copy(update={"seed": seed}) for seed in range(6)]
    found = {*map_in_order(_look_at, flights, jobs)}
    assert len(found) == len({pid for pid, *_ in found}) <= jobs


@pytest.mark.parametrize("jobs", [1, 2])
def test_a_worker_computes_once_what_its_calls_share(jobs):
    found = {*map_in_order(_shared, range(6), jobs)}
    assert len(found) == len({pid for _, pid in found}) <= jobs
    assert _shared(9) == (9, os.getpid()), "nothing is kept afterwards"


def test_results_before_a_worker_was_killed_are_kept(tmp_path):
    results = []

    def take(number):
        results.append(number)
        (tmp_path / str(number)).touch()

    end = take_each(map_in_order(partial(_kill_at_five, tmp_path), range(9), 2), take)
    assert end.exit_code == 6
    assert str(end).startswith("a worker has died")
    assert results == list(range(KILLED))


def test_ctrl_c_ends_the_workers_at_once():
    started = time.monotonic()
    done = map_in_order(time.sleep, [0.0, 60.0, 60.0], 2)
    next(done)
    with pytest.raises(KeyboardInterrupt):
        done.throw(KeyboardInterrupt)
    assert time.monotonic() - started < 30.0
