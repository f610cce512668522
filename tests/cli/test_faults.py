"""`cloudrc faults`: what was flown before an interrupt is kept."""

import json
from pathlib import Path

import pytest

from cloudrc.cli.main import main
from cloudrc.cli.pool import WorkerDiedError
from cloudrc.faults.scenario import Outcome, Result
from cloudrc.faults.scenarios import find
from cloudrc.faults.schedule import Schedule
from cloudrc.faults.trial import Finding


def test_a_fault_search_with_a_killed_worker_keeps_results(tmp_path, monkeypatch, capsys):
    def flown(function, work, jobs):
        for _, seed in work[:3]:
            yield Finding(Schedule(seed), ())
        raise WorkerDiedError("a worker was killed")

    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("cloudrc.cli.faults.map_in_order", flown)
    assert main("faults search --jobs 2 -o json".split()) == 6
    out, error = capsys.readouterr()
    assert json.loads(out)["count"] == 3
    assert error.count("\n") == 1
    assert error.startswith("cloudrc: a worker was killed")
    assert "continue with 'cloudrc faults search --first 4'" in error


@pytest.mark.parametrize(
    ("error", "code"), [(WorkerDiedError("a worker was killed"), 6), (KeyboardInterrupt(), 130)]
)
def test_an_interrupted_fault_run_keeps_its_results(error, code, tmp_path, monkeypatch, capsys):
    def flown(function, work, jobs):
        yield Result(find(work[0][0]), Outcome(), 0.0)
        raise error

    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("cloudrc.cli.faults.map_in_order", flown)
    assert main("faults run --all --junit f.xml -o json".split()) == code
    captured = capsys.readouterr()
    assert captured.err.startswith(f"cloudrc: {str(error) or 'interrupted'}; 1 of ")
    assert len(json.loads(captured.out)["faults"]) == 1
    assert Path("f.xml").read_text().count("<testcase") == 1
