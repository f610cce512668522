"""`cloudrc run --seeds N`: one table of all seeds, or of the finished ones."""

import csv
import io
import json
import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest

from cloudrc.cli.main import main
from cloudrc.cli.seeds import as_csv, as_table, summarise

KEYS = "mission.steps.count=1", "mission.steps.period_s=1.0", "criteria.settle_m=null"
SHORT = [f"--set={key}" for key in KEYS]
"""Overrides of `steps` for one second of flight."""


def report(seed, verdict="success", **numbers):
    found = {name: {"value": value, "unit": "m"} for name, value in numbers.items()}
    return {"seed": seed, "verdict": verdict, "failures": [], "numbers": found}


def written(folder):
    """Return the content of sweep.json, and the number of runs in sweep.csv."""
    document = json.loads((folder / "sweep/sweep.json").read_text())
    return document, len((folder / "sweep/sweep.csv").read_text().splitlines()) - 1


def test_many_seeds_become_one_table(folder, capsys):
    """A robot that touches nothing has failed, and so has the sweep."""
    line = ["run", "steps", "--seeds", "2", *SHORT, "--set", "criteria.contact=true"]
    assert main([*line, "--out", "sweep"]) == 1
    lines = capsys.readouterr().out.splitlines()
    assert lines[-1] == "sweep/sweep.json"
    assert "done 0/2" in lines
    assert any(line.startswith("prediction_error_rms") for line in lines)
    document, rows = written(folder)
    assert ([run["seed"] for run in document["runs"]], rows) == ([1, 2], 2)
    assert (document["done"], document["count"], document["interrupted"]) == (0, 2, False)
    assert document["overrides"][-1] == "criteria.contact=true"


def test_the_newest_sweep_and_the_newest_run_have_their_own_link(folder, monkeypatch):
    monkeypatch.setattr("cloudrc.cli.seeds._fly_one", lambda job: report(job[0].seed))
    monkeypatch.setattr("cloudrc.cli.pool.usable_cores", lambda: 1)
    assert main(["run", "steps", "--seeds", "1", *SHORT]) == 0
    assert (folder / "runs/latest-sweep/sweep.json").is_file()
    assert not (folder / "runs/latest").exists()


@pytest.mark.process
@pytest.mark.parametrize("how", [signal.SIGTERM, signal.SIGKILL])
def test_a_signal_ends_a_sweep_at_once(how, folder):
    """SIGTERM goes to the command, SIGKILL to one worker."""
    command = [sys.executable, "-m", "cloudrc", "run", "paper", "--seeds", "40", "--out", "sweep"]
    process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    assert "1/40" in process.stdout.readline()
    children = Path(f"/proc/{process.pid}/task/{process.pid}/children").read_text().split()
    workers = [p for p in children if "spawn_main" in Path(f"/proc/{p}/cmdline").read_text()]
    os.kill(int(workers[0]) if how == signal.SIGKILL else process.pid, how)
    _, errors = process.communicate(timeout=20)  # returns only once no worker holds the pipes
    assert ("cloudrc: a worker was killed" in errors) == (how == signal.SIGKILL)
    assert process.returncode == (6 if how == signal.SIGKILL else 130)
    assert "Traceback" not in errors
    document, _ = written(folder)
    assert document["interrupted"]
    assert 1 <= document["count"] < 40


def test_numbers_of_a_plugin_that_failed_do_not_count():
    failed = report(2, "failure", x=9.0) | {"failures": [{"code": "plugin_failed", "text": ""}]}
    summary = summarise([report(1, x=1.0), failed])
    assert (summary["done"], summary["count"]) == (1, 2)
    assert (summary["numbers"]["x"]["median"], summary["numbers"]["x"]["count"]) == (1.0, 1)


def test_runs_may_lack_a_number():
    runs = [report(1, x=1.0), report(2, "failure", y=2.0), report(3, x=3.0)]
    summary = summarise(runs)
    assert (summary["done"], summary["count"]) == (2, 3)
    assert (summary["numbers"]["x"]["median"], summary["numbers"]["x"]["count"]) == (2.0, 2)
    assert "(2 runs)" in as_table(summary)
    head, first, second, _ = csv.reader(io.StringIO(as_csv(runs)))
    assert head == ["seed", "verdict", "x [m]", "y [m]"]
    assert (first[2:], second[2:]) == (["1.0", ""], ["", "2.0"])
