"""`cloudrc run --seeds N`: one table of all seeds, or of the finished ones, and a sweep."""

import json
import subprocess
import sys

import pytest

from cloudrc.cli.seeds import as_table, summarise
from tests.cli.conftest import KEYS, SHORT


def row(seed, verdict="success", failures=(), **numbers):
    return {"seed": seed, "verdict": verdict, "failures": [*failures], "numbers": numbers}


@pytest.mark.usefixtures("no_page")
def test_many_seeds_become_one_table_and_a_sweep(folder, call):
    """A robot that touches nothing has failed, and so has the command."""
    line = "run steps --seeds 2 --set criteria.contact=true"
    lines = call(line, *SHORT, code=1).out.splitlines()
    assert lines[-1] == "runs/steps-virtual-2seeds-1/sweep.json"
    assert lines[0].startswith("    1/2  seed 1  failure: the arm never touched the board")
    assert "done 0/2" in lines
    assert any(line.startswith("prediction_error_rms") for line in lines)
    assert not (folder / "runs/latest").exists()
    summary = json.loads((folder / "runs/latest-sweep/sweep.json").read_text())
    assert (summary["seeds"], summary["counts"]) == ([1, 2], {"failure": 2})
    assert "criteria.contact=true" in summary["overrides"]
    assert len((folder / "runs/latest-sweep/table.csv").read_text().splitlines()) == 3
    key = json.loads((folder / "runs/latest-sweep/rows.jsonl").read_text().splitlines()[1])["key"]
    assert "the records are those of the sweep" in call("sweep fly runs/latest-sweep", key).err


def test_programs_get_a_document(call):
    document = json.loads(call("run steps --seeds 1 -o json --out sweep", *SHORT).out)
    assert (document["done"], document["count"], document["interrupted"]) == (1, 1, False)
    assert document["overrides"] == list(KEYS)
    assert [(run["seed"], run["verdict"]) for run in document["runs"]] == [(1, "success")]


@pytest.mark.process
def test_a_signal_ends_a_sweep_at_once(folder):
    command = [sys.executable, "-m", "cloudrc", "run", "paper", "--seeds", "40", "--out", "sweep"]
    process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    assert "1/40" in process.stdout.readline()
    process.terminate()
    _, errors = process.communicate(timeout=20)  # returns only once no worker holds the pipes
    assert process.returncode == 130
    assert "Traceback" not in errors
    counts = json.loads((folder / "sweep/sweep.json").read_text())["counts"]
    assert 1 <= sum(counts.values()) < 40


def test_numbers_may_be_missing_and_failed_plugins_do_not_count():
    failed = row(4, "failure", ["plugin_failed"], x=9.0)
    rows = [row(1, x=1.0), row(2, "failure", y=2.0), row(3, x=3.0), failed]
    summary = summarise(rows, {"x": "m", "y": "1"})
    assert (summary["done"], summary["count"]) == (2, 4)
    assert (summary["numbers"]["x"]["median"], summary["numbers"]["x"]["count"]) == (2.0, 2)
    assert "(2 runs)" in as_table(summary)
