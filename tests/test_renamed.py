"""Files that cloudrc 0.1.0 has written are read, and old names are understood."""

import json
import shutil
from pathlib import Path

import pytest

from cloudrc.renamed import NEW_NAMES, new_name

OLD = Path(__file__).parent / "fixtures" / "0.1.0"
"""A recording and a sweep, made by version 0.1.0. They stay as they are, and every later version
reads them. In each flight, wind blows the robot into a pipe."""


@pytest.fixture
def old(tmp_path, monkeypatch):
    """Work in a folder with a copy of the old files."""
    shutil.copytree(OLD, tmp_path / "old")
    monkeypatch.chdir(tmp_path / "old")
    new_name.cache_clear()
    return tmp_path / "old"


def test_an_old_recording_gives_the_numbers_and_failures_that_it_gave(old, call, no_page):
    before = json.loads((OLD / "recording" / "report.json").read_bytes())
    said = call("report recording -o json", code=1)
    after = json.loads(said.out)
    assert after["records_sha256"] == before["records_sha256"]
    codes, found = ([each["code"] for each in one["failures"]] for one in (before, after))
    assert found == [NEW_NAMES.get(code, code) for code in codes]
    assert "obstacle_touched" in found
    assert after["numbers"]["obstacle_contacts"] == before["numbers"]["pipe_contacts"]


@pytest.mark.parametrize("rows", ["flight.during('/telemetry')", "flight.recording['/telemetry']"])
def test_a_metric_of_ones_own_may_use_the_old_name_of_a_column(old, rows, call, caplog, no_page):
    measure = f"def measure(flight):\n    return max({rows}['pipe_contacts'])\n"
    (old / "mine.py").write_text(f'"""Count."""\nUNIT = "1"\n{measure}')
    report = json.loads(call("report recording --metric ./mine.py -o json", code=1).out)
    assert report["numbers"]["mine"]["value"] == 1
    assert caplog.messages == ["pipe_contacts is called obstacle_contacts now"]


def test_flights_of_an_old_sweep_are_compared_and_drawn_by_the_old_name(old, call, caplog):
    command = "compare last_sample constant_velocity --in sweep --number pipe_contacts -o json"
    document = json.loads(call(command).out)
    assert [*document["numbers"]] == ["obstacle_contacts"]
    assert document["pairs"] == 2
    assert caplog.messages == ["pipe_contacts is called obstacle_contacts now"]
    call("sweep figure sweep --x cloud.predictor --number pipe_contacts")
    assert (old / "sweep" / "figure.svg").stat().st_size


def test_an_old_experiment_flies_and_may_name_a_metric_by_its_old_name(old, call, no_page):
    call("run recording/config.yaml --mode virtual --set report.metrics=pipe_contacts", code=1)
