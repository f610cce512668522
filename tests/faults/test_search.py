"""Schedules in files, random ones, and the search: it stores what it finds, and continues."""

import json
import os
import signal
from pathlib import Path

import pytest

from cloudrc.cli.main import main
from cloudrc.errors import BadInputError
from cloudrc.faults.adversary import POLICIES, choose
from cloudrc.faults.invariants import Breach
from cloudrc.faults.schedule import CALM, KINDS, Event, Schedule, compose, dump, load
from cloudrc.faults.trial import Finding


@pytest.mark.parametrize("draw", [compose, choose])
def test_a_drawn_schedule_is_what_its_file_says(draw, tmp_path):
    path = tmp_path / "schedule.yaml"
    for seed in range(100):
        path.write_text(dump(draw(seed), "a note\nof two lines"))
        assert load(path) == draw(seed)


def test_random_schedules_have_all_faults_and_calm_at_the_end():
    drawn = [compose(seed) for seed in range(400)]
    events = [event for schedule in drawn for event in schedule.events]
    assert {event.kind for event in events} == set(KINDS)
    assert max(event.end for event in events) <= CALM
    assert 10 < sum(not schedule.events for schedule in drawn) < 60
    assert 70 < sum(schedule.hold_max < 60.0 for schedule in drawn) < 180
    # A hostile cloud flies alone or amid faults.
    hostile = {(chosen.policy, not chosen.events) for chosen in map(choose, range(200))}
    assert hostile == {(policy, alone) for policy in POLICIES for alone in (True, False)}


@pytest.mark.parametrize(
    "text",
    [
        *("", "[1, 2]", "{{", "[" * 2000, "seed: one", "seed: 1\nwind: 3", "seed: 1\nreorder: 2"),
        "seed: 1\nevents: [{kind: rain, at: 1}]",
        "seed: 1\nevents: [{kind: blackout, at: .nan}]",
        "seed: 1\nevents: [{kind: loss, at: 1, duration: 3, value: 1.5}]",
    ],
)
def test_a_file_that_is_no_schedule_is_bad_input(tmp_path, text):
    path = tmp_path / "schedule.yaml"
    path.write_text(text)
    with pytest.raises(BadInputError, match=r"schedule\.yaml: is no schedule of faults"):
        load(path)


BAD, INTERRUPTED = 5, 9
"""Seeds whose schedule fails, and in whose flight the search is interrupted."""


@pytest.fixture
def find(tmp_path, monkeypatch, capsys):
    """Search with a number of flights that take no time; return the document and stderr."""
    monkeypatch.chdir(tmp_path)

    def run(count, *flags, code):
        def fly(schedule):
            clock[0] += 60.0 / count
            if schedule.seed == INTERRUPTED:
                os.kill(os.getpid(), signal.SIGTERM)
            breaches = (Breach(1.0, "stuck", "not flown"),) if schedule.seed == BAD else ()
            return Finding(schedule, breaches, "", 1.0 / (1 + schedule.seed), 2.0, 2)

        clock = [0.0]
        monkeypatch.setattr("cloudrc.faults.trial.fly", fly)
        monkeypatch.setattr("cloudrc.cli.faults.time.monotonic", lambda: clock[0])
        assert main(["faults", "search", "-o", "json", *flags]) == code
        out, error = capsys.readouterr()
        return json.loads(out), error

    return run


def test_a_search_counts_stores_and_can_continue(find):
    told, _ = find(3, code=0)
    assert (told["kind"], told["first"], told["next"], told["count"]) == ("random", 1, 4, 3)
    told, _ = find(3, "--first", "4", code=1)
    assert (told["first"], told["next"]) == (4, 7)
    assert told["invariants"]["stuck"]["broken"] == 1
    assert told["invariants"]["fence"] == {"judged": 3, "broken": 0}
    assert told["smallest_margin_m"] == 1 / 7
    (failure,) = told["failures"]
    assert failure["seed"] == BAD
    assert load(Path(failure["file"])).seed == BAD
    assert Path(failure["file"]).read_text().startswith("# 1.000 s: stuck: not flown\n")
    told, error = find(9, "--first", "7", code=130)
    assert told["count"] == 2
    assert "continue with 'cloudrc faults search --first 9'" in error
    told, _ = find(1, "--adversarial", code=0)
    assert (told["kind"], told["count"]) == ("adversarial", 1)
    assert [told["invariants"][name]["judged"] for name in ("collision", "fence")] == [0, 1]


def test_a_search_and_its_schedule_are_flown_for_real(tmp_path, capsys):
    assert main(["faults", "search", "--minutes", "1e-9", "--store", str(tmp_path / "new")]) == 0
    assert "1 random schedules" in capsys.readouterr().out
    path = tmp_path / "schedule.yaml"
    path.write_text(dump(Schedule(1, events=(Event("blackout", 2.0, 0.5),), duration=3.0)))
    assert main(["faults", "run", str(path), "-o", "json"]) == 0
    told = json.loads(capsys.readouterr().out)
    assert (told["breaches"], len(told["records_sha256"])) == ([], 64)
