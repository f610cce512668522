# SPDX-License-Identifier: Apache-2.0

"""The robot flies straight into a body of a user's scene: the verdict names the body."""

import sys

import pytest

from cloudrc.config.load import load_experiment
from cloudrc.config.resolved import ResolvedExperiment
from cloudrc.flight.in_memory import fly_in_memory
from cloudrc.results.report.write import assess

TRACK = "time_s,x_m,y_m,z_m\n0,0,0,1\n1.5,0,0,1\n2.5,1.5,0,1\n4,1.5,0,1\n"
"""Up, and then 1.5 m ahead. Setpoints of a file are not checked before the flight."""


@pytest.fixture
def flown_into(tmp_path, scene_with):
    """Return a function that flies into a body 0.8 m ahead, and returns the assessment."""

    def fly(body, *settings):
        track = tmp_path / "track.csv"
        track.write_text(TRACK)
        keys = f"world.scene={scene_with(body)}", f"mission.setpoints={track}"
        keys = [*keys, "criteria.settle_m=null", *settings]
        return fly_in_memory(load_experiment("hover", keys))

    return fly


GEOM = '<geom type="box" size=".05 .5 2"/>'
PLACED = 'pos="1.2 0 0"'


@pytest.mark.parametrize(
    ("body", "name"),
    [
        (f'<body name="pillar" {PLACED}>{GEOM}</body>', "pillar"),
        (f"<body {PLACED}>{GEOM}</body>", "unnamed body 1"),
        (f'<geom type="box" size=".05 .5 2" {PLACED}/>', "world"),
        ('<body name="a" pos="1.2 0 1"><geom size=".3"/></body>', "a"),
    ],
)
def test_a_body_that_the_robot_touches_fails_the_flight(flown_into, body, name):
    found = flown_into(body)
    touched = [each for each in found.verdict.failures if each.code == "obstacle_touched"]
    assert found.verdict.outcome == "failure"
    assert touched[0].text.startswith(f"the robot touched {name}")
    assert touched[0].time == pytest.approx(2.3, abs=0.6)
    assert touched[0].place == pytest.approx((0.75, 0.0, 1.0), abs=0.3)
    counted = found.flight.during("/telemetry")["obstacle_contacts"][-1]
    assert counted == found.numbers["obstacle_contacts"].value > 0


def test_what_nothing_can_touch_is_no_obstacle(flown_into):
    seen = GEOM.replace("/>", ' contype="0" conaffinity="0"/>')
    found = flown_into(f'<body name="ghost" {PLACED}>{seen}</body>')
    assert (found.verdict.outcome, found.numbers["obstacle_contacts"].value) == ("success", 0)
    assert [note for note in found.notes if note.startswith("The robot flies through ghost: ")]


def test_the_report_has_the_clearance_from_any_obstacle(flown_into):
    assert "min_clearance_flight" not in flown_into("").numbers
    found = flown_into(f'<body name="post" pos="3 0 0">{GEOM}</body>')
    assert 0.0 < found.numbers["min_clearance_flight"].value < 3.0
    assert not [note for note in found.notes if "No clearance is known" in note]


def test_a_report_needs_no_mujoco(flown_into, monkeypatch):
    found = flown_into(f'<body name="post" pos="3 0 0">{GEOM}</body>')
    monkeypatch.setitem(sys.modules, "mujoco", None)
    experiment = ResolvedExperiment.model_validate_json(found.experiment.model_dump_json())
    notes = assess(found.flight.recording, experiment, found.run).notes
    (note,) = [note for note in notes if note.startswith("No clearance is known from")]
    assert note.endswith("all bodies but declared tubes: MuJoCo is not installed.")


def test_a_robot_without_a_probe_touches_with_any_part(flown_into):
    board = f'<body name="wall" {PLACED}>{GEOM}</body>'
    touch = "mission.touch={body: wall, speed_max_mps: 9}"
    found = flown_into(board, touch, "world.robot=nano")
    assert found.verdict.failures == ()
    assert found.numbers["contact_time"].value > 0
