"""Files that cloudrc 0.1.0 has written are read, and old names are understood."""

import json
import shutil
from pathlib import Path

import numpy as np
import pytest

from cloudrc.config.load import load_experiment
from cloudrc.errors import BadInputError
from cloudrc.record.columns import Recording
from cloudrc.renamed import NEW_NAMES, new_column, new_key, new_name
from cloudrc.runs.grid import read_grid
from cloudrc.runs.trials import Asked, Trials

OLD = Path(__file__).parent / "fixtures" / "0.1.0"
"""A recording and a sweep, made by version 0.1.0. They stay as they are, and every later version
reads them. In each flight, wind blows the robot into a pipe."""

OLD_KEY, NEW_KEY = "world.low_level", "world.onboard"
AXIS = f"{OLD_KEY}.gain_p"


@pytest.fixture
def old(tmp_path, monkeypatch):
    """Work in a folder with a copy of the old files."""
    shutil.copytree(OLD, tmp_path / "old")
    monkeypatch.chdir(tmp_path / "old")
    new_name.cache_clear()
    new_column.cache_clear()
    return tmp_path / "old"


def test_an_old_recording_gives_the_numbers_and_failures_that_it_gave(old, call, no_page):
    before = json.loads((OLD / "recording" / "report.json").read_bytes())
    said = call("report recording -o json", code=1)
    after = json.loads(said.out)
    codes, found = ([each["code"] for each in one["failures"]] for one in (before, after))
    assert found == [NEW_NAMES.get(code, code) for code in codes]
    assert "obstacle_touched" in found
    assert after["numbers"]["obstacle_contacts"] == before["numbers"]["pipe_contacts"]


def test_every_topic_of_an_old_recording_is_read_with_its_present_columns():
    recording = Recording.read(OLD / "recording" / "mission.mcap")
    assert recording.note == ""
    assert len(recording["/telemetry"]) == len(recording["/odometry"]) > 50
    assert len(recording["/contact_force"]) == len(recording["/ground_truth"]) > 50
    assert recording["/contact_force"]["force_peak"].max() == 0.0, "a wall is no touch of the probe"
    assert not recording["/contact"]["by_probe"].any()
    speed = np.linalg.norm(recording["/contact"]["touch_velocity"], axis=1)
    assert (speed > 0.1).any()
    assert len(recording["/sensor"]) == 0


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


@pytest.fixture
def old_axis(old):
    """Give the old sweep an axis that is a key with an old name, as a sweep of 0.1.0 may have."""
    for file in ("rows.jsonl", "sweep.json"):
        text = (old / "sweep" / file).read_text().replace("cloud.predictor", f"{OLD_KEY}.gain_p")
        (old / "sweep" / file).write_text(text)
    new_key.cache_clear()
    return old


@pytest.mark.parametrize(
    "sides", ["last_sample constant_velocity", f"{AXIS}=last_sample {AXIS}=constant_velocity"]
)
def test_an_axis_with_an_old_name_is_read_with_its_new_one_and_one_line(
    old_axis, sides, call, caplog
):
    call(f"compare {sides} --in sweep -o json")
    call(f"sweep figure sweep --x {AXIS}")
    status = call("sweep status sweep -o json").out
    assert {each["axis"] for each in json.loads(status)["axes"]} == {f"{NEW_KEY}.gain_p"}
    assert caplog.messages == [f"{AXIS} is called {NEW_KEY}.gain_p now"]


def test_a_sweep_and_a_search_may_use_the_old_name_of_a_key(tmp_path):
    sweep = tmp_path / "sweep.yaml"
    sweep.write_text(f"experiment: hover\ngrid: {{{OLD_KEY}.integral_limit_xy: [0.1, 0.3]}}\n")
    assert [*read_grid(sweep).axes] == [f"{NEW_KEY}.integral_limit_xy"]
    sweep.write_text(f"grid: {{{OLD_KEY}.gain_p: [1], {NEW_KEY}.gain_p: [2]}}\n")
    with pytest.raises(BadInputError, match=r"world\.onboard\.gain_p is given twice"):
        read_grid(sweep)
    trials = Trials(Asked(f"{OLD_KEY}.integral_limit_xy", "hover", [], 1, 0.2))
    assert trials.asked.key == f"{NEW_KEY}.integral_limit_xy"
    assert trials.present * trials.size == pytest.approx(0.1)  # the published limit


def test_an_old_and_a_new_key_for_the_same_value_are_refused(tmp_path):
    mine = tmp_path / "mine.yaml"
    mine.write_text("world: {low_level: {gain_p: [1, 1, 1]}, onboard: {gain_p: [1, 1, 1]}}")
    with pytest.raises(BadInputError, match=r"mine\.yaml:1: world\.onboard is given twice"):
        load_experiment(mine)
    both = [f"{key}.integral_limit_z=1" for key in (OLD_KEY, NEW_KEY)]
    with pytest.raises(BadInputError, match=r"integral_limit_z: is set twice"):
        load_experiment("hover", both)
