# SPDX-License-Identifier: Apache-2.0

"""`cloudrc place`: where should the controller run?"""

import json

import pytest

from cloudrc.config.load import load_experiment
from cloudrc.doors.cli.main import main
from cloudrc.flight.assembly.cloud import build_compute_time
from cloudrc.studies.place import DISTURBANCES, PlaceStudy, judge
from tests.doors.cli.conftest import SHORT


@pytest.fixture(autouse=True)
def here(tmp_path, one_core, monkeypatch):
    monkeypatch.chdir(tmp_path)


def place(name, succeeded=(1,) * 8, **numbers):
    """Return a place with one value per seed."""
    numbers = {"hold_s": [0.0] * 8, "cross_track_mm": [20.0, 30.0] * 4} | numbers
    middle = {key: sum(values) / len(values) for key, values in numbers.items()}
    by_seed = {"succeeded": [*succeeded], **numbers}
    count = len(succeeded)
    return {"name": name, "succeeded": sum(succeeded), "flown": count, "by_seed": by_seed, **middle}


@pytest.mark.parametrize("speed", [0.2, 1, 2])
def test_a_computation_takes_the_time_of_the_reference_divided_by_the_speed(speed):
    experiment = load_experiment("steps", ["cloud.compute_ms=10", f"cloud.speed={speed}"])
    assert build_compute_time(experiment).end(0) == round(10e6 / speed)


@pytest.mark.parametrize(
    ("other", "best"),
    [
        ({"succeeded": [0] * 6 + [1] * 2, "cross_track_mm": [1.0] * 8}, ["edge"]),
        ({"succeeded": [0] + [1] * 7}, ["edge", "other"]),  # 7 of 8 may be chance
        ({"hold_s": [1.0, 2.0] * 4, "cross_track_mm": [1.0] * 8}, ["edge"]),
        ({"cross_track_mm": [22.0, 33.0] * 4}, ["edge"]),
        ({"cross_track_mm": [18.0, 27.0] * 4}, ["other"]),
        ({"cross_track_mm": [40.0, 30.0] * 4}, ["edge", "other"]),  # worse with half the seeds
        ({"cross_track_mm": [20.9, 31.0] * 4}, ["edge", "other"]),
    ],
)
def test_the_best_place_is_better_by_the_sign_test_over_the_seeds(other, best):
    assert judge([place("edge"), place("other", **other)])["places"] == best


def test_five_seeds_cannot_decide():
    found = judge([place("edge", [1] * 5), place("cloud", [0] * 5)])
    assert found["places"] == ["edge", "cloud"]


def test_no_place_is_best_where_no_robot_succeeds():
    assert judge([place("edge", [0] * 8), place("cloud", [0] * 8)])["places"] == []


def test_a_setting_replaces_a_disturbance():
    study = PlaceStudy("steps", ["world.wind={gust_mps: 2}"], [0], [1], ["edge"], 1, calm=False)
    assert study.disturbances.keys() == {k for k in DISTURBANCES if "wind" not in k}


def test_a_small_study_flies_only_what_is_missing(capsys):
    def call(*words):
        command = ["place", "steps", *SHORT, "--seeds", "1", "--compute", "60", "--out", "s"]
        assert main([*command, "--places", "onboard,edge", *words]) == 0
        return capsys.readouterr()

    shown = call("--robots", "1,2").out.splitlines()
    head = "steps in wind, with a payload (--calm: without), seeds 1 to 1, 4 flights: "
    assert shown[0].startswith(head)
    assert "world.wind.velocity_mps=[1, 0], " in shown[0]
    (one,) = [line for line in shown if line.startswith("60 ms, 1")]
    assert one.startswith("60 ms, 1 robot: undecided: fewer than 6 seeds")
    again = call("--robots", "2", "-o", "json")
    assert ", 0 flights" in again.err
    document = json.loads(again.out)
    assert document["best"][0]["places"] == ["onboard", "edge"]
    onboard, edge = document["points"]
    assert (onboard["rate_kbit"], onboard["why"]) == (0, "not_started")
    assert edge["flown"] == 2
    assert 100 < edge["age_ms"] < 115
