"""Work on several cores: order, number of processes, killed workers, Ctrl-C."""

from __future__ import annotations

import json
import multiprocessing
import os
import signal
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

from cloudrc.cli.main import main
from cloudrc.cli.pool import BATCH_MAX, WorkerDiedError, map_in_order
from cloudrc.faults.report import Result
from cloudrc.faults.scenario import Outcome
from cloudrc.faults.scenarios import find
from cloudrc.faults.schedule import Schedule
from cloudrc.faults.trial import Finding

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


def _fly(schedule: Schedule, keep: bool = False) -> Finding:
    if schedule.seed == KILLED:
        time.sleep(0.5)  # until earlier results are delivered
    _kill_at_five(schedule.seed)
    return Finding(schedule, ())


def test_a_fault_search_with_a_killed_worker_keeps_results(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("cloudrc.faults.search.fly", _fly)
    assert main("faults search --jobs 2 -o json".split()) == 6
    out, error = capsys.readouterr()
    assert error.count("\n") == 1
    assert error.startswith("cloudrc: a worker was killed")
    count = json.loads(out)["count"]
    assert 1 <= count < KILLED
    assert f"continue with 'cloudrc faults search --first {count + 1}'" in error


def _kill(which: tuple[str, int]) -> None:
    os.kill(os.getpid(), signal.SIGKILL)


def _interrupt(which: tuple[str, int]) -> Result:
    scenario = find(which[0])
    if scenario.number > 1:
        raise KeyboardInterrupt
    return Result(scenario, Outcome(), 0.0)


@pytest.mark.parametrize(
    ("how", "jobs", "code", "word", "flown"),
    [(_kill, 2, 6, "a worker was killed", 0), (_interrupt, 1, 130, "interrupted", 1)],
)
def test_an_interrupted_fault_run_keeps_its_results(
    how: object,
    jobs: int,
    code: int,
    word: str,
    flown: int,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("cloudrc.cli.faults._run", how)
    line = f"faults run --all --jobs {jobs} --junit f.xml -o json"
    assert main(line.split()) == code
    captured = capsys.readouterr()
    assert captured.err.startswith(f"cloudrc: {word}")
    assert f"; {flown} of " in captured.err
    assert len(json.loads(captured.out)["faults"]) == flown
    assert Path("f.xml").read_text().count("<testcase") == flown


def test_ctrl_c_ends_the_workers_at_once() -> None:
    started = time.monotonic()
    done = map_in_order(time.sleep, [0.0, 60.0, 60.0], 2)
    next(done)
    with pytest.raises(KeyboardInterrupt):
        done.throw(KeyboardInterrupt)
    assert time.monotonic() - started < 30.0
    assert multiprocessing.active_children() == []


def test_ctrl_c_ends_a_worker_that_ignores_sigterm(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """A worker has its parent's handlers at first and may lose their interrupt."""
    ignore_sigterm = lambda parent: signal.signal(signal.SIGTERM, signal.SIG_IGN)  # noqa: E731
    monkeypatch.setattr("cloudrc.cli.pool._begin", ignore_sigterm)
    test_ctrl_c_ends_the_workers_at_once()
