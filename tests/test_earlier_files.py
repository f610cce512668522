# SPDX-License-Identifier: Apache-2.0

"""Files that cloudrc 0.1.0 has written are read."""

import json
import shutil
from pathlib import Path

import numpy as np
import pytest

from cloudrc.results.record.columns import Recording

OLD = Path(__file__).parent / "fixtures" / "0.1.0"
"""A recording and a sweep. From the release of 0.1.0 on they stay as they are, and every later
version reads them. In each flight, wind blows the robot into a pipe."""


@pytest.fixture
def old(tmp_path, monkeypatch):
    """Work in a folder with a copy of the old files."""
    shutil.copytree(OLD, tmp_path / "old")
    monkeypatch.chdir(tmp_path / "old")
    return tmp_path / "old"


def test_an_old_recording_gives_the_numbers_and_failures_that_it_gave(old, as_json, no_page):
    before = json.loads((OLD / "recording" / "report.json").read_bytes())
    after = as_json("report recording", code=1)
    codes, found = ([each["code"] for each in one["failures"]] for one in (before, after))
    assert "obstacle_touched" in found
    assert found == codes
    assert after["numbers"]["obstacle_contacts"] == before["numbers"]["obstacle_contacts"]


def test_every_topic_of_an_old_recording_is_read():
    recording = Recording.read(OLD / "recording" / "mission.mcap")
    assert recording.note == ""
    assert len(recording["/telemetry"]) == len(recording["/odometry"]) > 50
    assert len(recording["/contact_force"]) == len(recording["/ground_truth"]) > 50
    assert recording["/contact_force"]["force_peak"].max() == 0.0, "a wall is no touch of the probe"
    assert not recording["/contact"]["by_probe"].any()
    speed = np.linalg.norm(recording["/contact"]["touch_velocity"], axis=1)
    assert (speed > 0.1).any()


def test_flights_of_an_old_sweep_are_compared_and_drawn(old, call, as_json):
    command = "compare last_sample constant_velocity --in sweep --metric obstacle_contacts"
    document = as_json(command)
    assert [*document["numbers"]] == ["obstacle_contacts"]
    assert document["pairs"] == 2
    call("sweep figure sweep --x cloud.predictor --metric obstacle_contacts")
    assert (old / "sweep" / "figure.svg").stat().st_size


def test_an_old_experiment_flies(old, call, no_page):
    call("run recording/config.yaml --mode virtual", code=1)
