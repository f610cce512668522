"""`cloudrc place`: where should the controller run?"""

import json

import pytest

from cloudrc import assembly
from cloudrc.cli.main import main
from cloudrc.config.load import load_experiment
from cloudrc.studies.place import DISTURBANCES, PlaceStudy, judge
from tests.cli.conftest import SHORT


@pytest.fixture(autouse=True)
def here(tmp_path, one_core, monkeypatch):
    monkeypatch.chdir(tmp_path)


def place(name, succeeded=2, **numbers):
    numbers = {"hold_s": [0.0, 0.0], "cross_track_mm": [20.0, 30.0]} | numbers
    middle = {key: sum(values) / 2 for key, values in numbers.items()}
    return {"name": name, "succeeded": succeeded, "flown": 2, "by_seed": numbers, **middle}


@pytest.mark.parametrize("speed", [0.2, 1, 2])
def test_a_computation_takes_the_time_of_the_reference_divided_by_the_speed(speed):
    experiment = load_experiment("steps", ["cloud.compute_ms=10", f"cloud.speed={speed}"])
    assert assembly.build_compute_time(experiment).end(0) == round(10e6 / speed)


@pytest.mark.parametrize(
    ("other", "best"),
    [
        ({"succeeded": 1, "cross_track_mm": [1.0, 1.0]}, ["edge"]),
        ({"hold_s": [1.0, 2.0], "cross_track_mm": [1.0, 1.0]}, ["edge"]),
        ({"cross_track_mm": [22.0, 33.0]}, ["edge"]),
        ({"cross_track_mm": [18.0, 27.0]}, ["other"]),
        ({"cross_track_mm": [40.0, 30.0]}, ["edge", "other"]),  # worse with one seed alone
        ({"cross_track_mm": [20.9, 31.0]}, ["edge", "other"]),
    ],
)
def test_the_best_place_is_better_with_every_seed(other, best):
    assert judge([place("edge"), place("other", **other)])["places"] == best


def test_no_place_is_best_where_no_robot_succeeds():
    assert judge([place("edge", 0), place("cloud", 0)])["places"] == []


def test_a_setting_replaces_a_disturbance():
    study = PlaceStudy("steps", ["world.wind={gust_mps: 2}"], [0], [1], ["edge"], 1, calm=False)
    assert study.disturbances.keys() == {k for k in DISTURBANCES if "wind" not in k}


def test_a_small_study_names_the_best_place_and_flies_only_what_is_missing(capsys):
    def call(*words):
        command = ["place", "steps", *SHORT, "--seeds", "1", "--compute", "60", "--out", "s"]
        assert main([*command, "--places", "onboard,edge", *words]) == 0
        return capsys.readouterr()

    shown = call("--robots", "1,2").out.splitlines()
    head = "steps in wind, with a payload (--calm: without), seeds 1 to 1, 4 flights: "
    assert shown[0].startswith(head)
    assert "world.wind.velocity_mps=[1, 0], " in shown[0]
    one = "60 ms, 1 robot: edge: 1/1 succeed, not 0/1 (onboard)"
    assert [line for line in shown if line.startswith("60 ms, 1")] == [one]
    again = call("--robots", "2", "-o", "json")
    assert ", 0 flights" in again.err
    document = json.loads(again.out)
    assert document["best"][0]["places"] == ["edge"]
    onboard, edge = document["points"]
    assert (onboard["rate_kbit"], onboard["why"]) == (0, "not_started")
    assert edge["flown"] == 2
    assert 100 < edge["age_ms"] < 115
