"""`cloudrc run --seeds N`: one table of all seeds, or of the finished ones."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from cloudrc.cli import sweep
from cloudrc.cli.main import main
from cloudrc.cli.pool import WorkerDiedError
from tests.conftest import nightly

SHORT = ["--set", "mission.steps.count=1", "--set", "mission.steps.period_s=1.0"]
"""Overrides of `steps` for one second of flight."""


@pytest.fixture(autouse=True)
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.chdir(tmp_path)
    return tmp_path


def test_many_seeds_become_one_table(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["run", "steps", "--seeds", "2", *SHORT, "--out", "sweep"]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert lines[-1] == "sweep/sweep.json"
    assert "done 2/2" in lines
    assert any(line.startswith("prediction_error_rms") for line in lines)
    document = json.loads((folder / "sweep/sweep.json").read_text())
    assert [run["seed"] for run in document["runs"]] == [1, 2]
    assert (document["done"], document["count"], document["interrupted"]) == (2, 2, False)
    assert len((folder / "sweep/sweep.csv").read_text().splitlines()) == 3


@pytest.mark.parametrize("finished", [0, 2])
@pytest.mark.parametrize(
    ("error", "code", "word"),
    [
        (KeyboardInterrupt(), 130, "interrupted"),
        (WorkerDiedError("killed"), 6, "a worker was killed"),
    ],
)
def test_an_interrupted_sweep_keeps_what_is_finished(
    error: BaseException,
    code: int,
    word: str,
    finished: int,
    folder: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    def reports(*arguments: object) -> Iterator[dict[str, Any]]:
        for seed in range(1, finished + 1):
            numbers = {"duration": {"value": float(seed), "unit": "s"}}
            yield {"seed": seed, "verdict": "success", "failures": [], "numbers": numbers}
        raise error

    monkeypatch.setattr(sweep, "map_in_order", reports)
    assert main(["run", "steps", "--seeds", "9", "--out", "sweep"]) == code
    captured = capsys.readouterr()
    assert f"cloudrc: {word}" in captured.err
    assert f": {finished} of 9 seeds are finished\n" in captured.err
    assert captured.out.splitlines()[-1] == "sweep/sweep.json"
    document = json.loads((folder / "sweep/sweep.json").read_text())
    assert [run["seed"] for run in document["runs"]] == list(range(1, finished + 1))
    assert (document["count"], document["interrupted"]) == (finished, True)
    assert len((folder / "sweep/sweep.csv").read_text().splitlines()) == 1 + finished


def _begin_sweep() -> subprocess.Popen[str]:
    command = [sys.executable, "-m", "cloudrc", "run", "paper", "--seeds", "40", "--out", "sweep"]
    process = subprocess.Popen(
        command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, start_new_session=True
    )
    assert process.stdout is not None
    assert "1/40" in process.stdout.readline()
    return process


@pytest.mark.process
@pytest.mark.parametrize("number", [signal.SIGTERM, *nightly(signal.SIGINT, signal.SIGHUP)])
def test_a_signal_ends_a_sweep_at_once(number: int, folder: Path) -> None:
    """A terminal sends SIGINT and SIGHUP to the whole process group, but SIGTERM goes to one."""
    process = _begin_sweep()
    start = time.monotonic()
    if number != signal.SIGTERM:
        os.killpg(process.pid, number)
    else:
        process.send_signal(number)
    _, errors = process.communicate(timeout=20)  # returns only once no worker holds the pipes
    assert time.monotonic() - start < 3.0
    assert process.returncode == 130
    assert "Traceback" not in errors
    document = json.loads((folder / "sweep/sweep.json").read_text())
    assert document["interrupted"]
    assert 1 <= document["count"] < 40


@pytest.mark.process
def test_a_sweep_that_loses_a_worker_keeps_what_is_finished(folder: Path) -> None:
    process = _begin_sweep()
    children = Path(f"/proc/{process.pid}/task/{process.pid}/children").read_text().split()
    workers = [pid for pid in children if "spawn_main" in Path(f"/proc/{pid}/cmdline").read_text()]
    os.kill(int(workers[0]), signal.SIGKILL)
    _, errors = process.communicate(timeout=20)
    assert process.returncode == 6
    assert "Traceback" not in errors
    assert "cloudrc: a worker was killed" in errors
    document = json.loads((folder / "sweep/sweep.json").read_text())
    assert document["interrupted"]
    assert 1 <= document["count"] < 40
