"""`cloudrc sweep run --on kubernetes`: rows come from the lines of the pods' logs, each once."""

import json
from pathlib import Path

import pytest

from cloudrc.cli.main import main
from cloudrc.cluster import batch
from cloudrc.sweep.plan import read_plan
from cloudrc.sweep.store import make_row, read_rows
from tests.sweep.conftest import write_sweep

__all__ = ["write_sweep"]
FLOWN = {"verdict": "success", "failures": [], "text": "", "numbers": {}, "records_sha256": ""}


@pytest.fixture
def cluster(monkeypatch):
    """Replace the cluster; return the lines that the pods print."""
    lines = []
    monkeypatch.setattr("cloudrc.cli.sweep_pods.release_from_flags", lambda options: Release())
    monkeypatch.setattr(batch, "start", lambda *given, **words: None)
    monkeypatch.setattr(batch, "read_lines", lambda release, name, tell: take(lines))
    return lines


def take(lines):
    """Yield the lines of one Job, which end before a line "end"."""
    while lines and (line := lines.pop(0)) != "end":
        yield line


class Release:
    where = "in namespace 'lab'"


def test_each_row_is_taken_once_and_other_lines_are_not(write_sweep, cluster):
    path = write_sweep()
    rows = [make_row(flight, FLOWN) for flight in read_plan(path).flights.values()]
    lines = [json.dumps(row) for row in rows]
    foreign = json.dumps(rows[0] | {"key": "0"})
    cluster += ["", "a warning", '{"key": "x"}', "[1]", "2", foreign, *lines[::-1], *lines]
    assert main(["sweep", "run", str(path), "--out", "grid", "--on", "kubernetes"]) == 0
    assert list(read_rows(Path("grid")).values()) == rows[::-1]
    assert len(Path("grid/rows.jsonl").read_text().splitlines()) == 4


def test_rows_that_are_lost_with_their_pod_are_flown_again(write_sweep, cluster, capsys):
    path = write_sweep()
    lines = [json.dumps(make_row(f, FLOWN)) for f in read_plan(path).flights.values()]
    cluster += [*lines[:3], "end", *lines[3:]]
    assert main(["sweep", "run", str(path), "--out", "grid", "--on", "kubernetes"]) == 0
    assert len(read_rows(Path("grid"))) == 4
    assert "the rows of 1 flights were lost with their pods" in capsys.readouterr().err


def test_rows_that_do_not_come_are_told(write_sweep, cluster, capsys):
    path = write_sweep()
    first, *_ = read_plan(path).flights.values()
    cluster.append(json.dumps(make_row(first, FLOWN)))
    assert main(["sweep", "run", str(path), "--out", "grid", "--on", "kubernetes"]) == 5
    assert "the pods printed no row of 3 flights" in capsys.readouterr().err
    assert list(read_rows(Path("grid"))) == [first.key]


def test_files_that_no_pod_has_are_refused(write_sweep, cluster, tmp_path, capsys):
    (tmp_path / "mine.py").write_text("def build():\n    return lambda *given: given[0]\n")
    path = write_sweep({"cloud.predictor": ["./mine.py"]})
    assert main(["sweep", "run", str(path), "--out", "grid", "--on", "kubernetes"]) == 2
    assert "mine.py: the pods do not have this file" in capsys.readouterr().err
    assert not Path("grid").exists()
