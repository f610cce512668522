"""`cloudrc sweep run --on kubernetes`: rows come from the lines of the pods' logs, each once."""

import json
from pathlib import Path

import pytest

from cloudrc.cluster import batch
from cloudrc.sweep.plan import read_plan
from cloudrc.sweep.store import make_row, read_rows
from tests.sweep.conftest import write_sweep

__all__ = ["write_sweep"]
FLOWN = {"verdict": "success", "failures": [], "text": "", "numbers": {}, "records_sha256": ""}


class Release:
    where = "in namespace 'lab'"


@pytest.fixture
def fly(write_sweep, monkeypatch, call):
    """Return a function that flies a sweep in replaced pods, which print lines.

    Each argument is a list of the lines of one Job. `make(rows)` returns such lists.
    """
    monkeypatch.setattr("cloudrc.cli.sweep_pods.release_from_flags", lambda options: Release())
    monkeypatch.setattr(batch, "start", lambda *given, **words: None)
    path = write_sweep()

    def run(make, code):
        made = [make_row(flight, FLOWN) for flight in read_plan(path).flights.values()]
        jobs = make([json.dumps(row) for row in made])
        monkeypatch.setattr(batch, "read_lines", lambda *given: jobs.pop(0) if jobs else [])
        error = call("sweep run --out grid --on kubernetes", path, code=code).err
        return made, list(read_rows(Path("grid")).values()), error

    return run


def test_each_row_is_taken_once_and_other_lines_are_not(fly):
    others = ["", "a warning", '{"key": "x"}', "[1]", "2"]

    def make(lines):
        foreign = json.dumps(json.loads(lines[0]) | {"key": "0"})
        return [[*others, foreign, *lines[::-1], *lines]]

    made, read, _ = fly(make, 0)
    assert read == made[::-1]
    assert len(Path("grid/rows.jsonl").read_text().splitlines()) == 4


@pytest.mark.parametrize(
    ("make", "code", "count", "said"),
    [
        (lambda lines: [lines[:3], lines[3:]], 0, 4, "rows of 1 flights were lost with their pods"),
        (lambda lines: [lines[:1]], 5, 1, "the pods printed no row of 3 flights"),
    ],
)
def test_lost_rows_are_flown_again_as_long_as_rows_arrive(make, code, count, said, fly):
    made, read, error = fly(make, code)
    assert read == made[:count]
    assert said in error


def test_files_that_no_pod_has_are_refused(write_sweep, tmp_path, call):
    (tmp_path / "mine.py").write_text("def build():\n    return lambda *given: given[0]\n")
    path = write_sweep({"cloud.predictor": ["./mine.py"]})
    error = call("sweep run --out grid --on kubernetes", path, code=2).err
    assert "mine.py: the pods do not have this file" in error
    assert not Path("grid").exists()
