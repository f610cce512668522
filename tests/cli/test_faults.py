# SPDX-License-Identifier: Apache-2.0

"""`cloudrc faults`: results are told, and what was flown before an interrupt is kept."""

import json
import os
import pickle
import signal
from dataclasses import replace
from functools import partial
from pathlib import Path

import pytest

from cloudrc.faults.measures import Outcome
from cloudrc.faults.rules import Breach
from cloudrc.faults.scenarios import SCENARIOS
from cloudrc.faults.schedule import FaultEvent, Schedule, dump, load
from cloudrc.faults.search import run_fault
from cloudrc.faults.trial import TrialResult
from cloudrc.trials.workers import WorkerDiedError

KILLED = WorkerDiedError("a worker was killed")


def test_the_command_prints_json(as_json):
    Path("F17").mkdir()  # a folder is no schedule
    printed = as_json("faults run F17")
    assert (printed["schemaVersion"], printed["faults"][0]["result"]) == (1, "passed")
    assert {check["unit"] for check in printed["faults"][0]["checks"]} == {"", "m", "m/s", "yes"}
    assert pickle.dumps(run_fault("F27", 1)), "a result comes back from another process"


def test_a_failed_check_ends_in_exit_code_1(monkeypatch, call):
    def run(outcome, number):
        outcome.same("collisions", 2.0 * (number == 1), 0)
        if number == 2:
            raise ValueError("broken")

    for name, each in SCENARIOS.items():
        fake = replace(each, inject=partial(run, number=each.number))
        monkeypatch.setitem(SCENARIOS, name, fake)
    out = call("faults run --all", code=1).out
    for said in ("x collisions: 2 (0)", "22 of 24 passed, 2 failed", "ValueError: broken"):
        assert said in out


@pytest.mark.parametrize(
    ("line", "error", "code", "said"),
    [
        ("search --jobs 2", KILLED, 6, "to continue, add --first 2"),
        ("run --all", KILLED, 6, "cloudrc: a worker was killed; 1 of "),
    ],
)
def test_what_was_flown_before_an_interrupt_is_kept(line, error, code, said, monkeypatch, call):
    def flown(function, work, jobs):
        yield TrialResult(Schedule(1), ()) if "search" in line else Outcome()
        raise error

    place = "faults.search" if "search" in line else "cli.faults"
    monkeypatch.setattr(f"cloudrc.{place}.map_in_order", flown)
    out, message = call(f"faults {line} -o json", code=code)
    document = json.loads(out)
    assert document.get("count") == 1 or len(document["faults"]) == 1
    assert said in message
    assert message.count("\n") == 1


BAD, INTERRUPTED = 5, 9
"""Seeds whose schedule fails, and in whose flight the search is interrupted."""


@pytest.fixture
def find(monkeypatch, call):
    """Search with a number of flights that take no time; return the document and stderr."""

    def run(count, flags="", code=0):
        def fly(schedule):
            clock[0] += 60.0 / count
            if schedule.seed == INTERRUPTED:
                os.kill(os.getpid(), signal.SIGTERM)
            breaches = (Breach(1.0, "stuck", "not flown"),) if schedule.seed == BAD else ()
            return TrialResult(schedule, breaches, "", 1.0 / (1 + schedule.seed), 2.0, 2)

        clock = [0.0]
        monkeypatch.setattr("cloudrc.faults.trial.fly", fly)
        monkeypatch.setattr("cloudrc.faults.search.time.monotonic", lambda: clock[0])
        out, error = call(f"faults search -o json {flags}", code=code)
        return json.loads(out), error

    return run


@pytest.mark.child
def test_a_search_counts_stores_and_can_continue(find):
    told, _ = find(3)
    assert (told["kind"], told["first"], told["next"], told["count"]) == ("random", 1, 4, 3)
    told, _ = find(3, "--first 4", code=1)
    assert (told["first"], told["next"]) == (4, 7)
    assert told["invariants"]["stuck"]["broken"] == 1
    assert told["invariants"]["fence"] == {"judged": 3, "broken": 0}
    assert told["smallest_margin_m"] == 1 / 7
    (failure,) = told["failures"]
    assert failure["seed"] == BAD
    assert load(Path(failure["file"])).seed == BAD
    assert Path(failure["file"]).read_text().startswith("# 1.000 s: stuck: not flown\n")
    told, error = find(9, "--first 7", code=130)
    assert told["count"] == 2
    assert "to continue, add --first 9" in error
    told, _ = find(1, "--adversarial")
    assert (told["kind"], told["count"]) == ("adversarial", 1)
    assert [told["invariants"][name]["judged"] for name in ("collision", "fence")] == [0, 1]


def test_a_schedule_is_flown_for_real(as_json):
    schedule = Schedule(1, events=(FaultEvent("blackout", 2.0, 0.5),), duration=3.0)
    Path("schedule.yaml").write_text(dump(schedule))
    told = as_json("faults run schedule.yaml")
    assert (told["breaches"], len(told["records_sha256"])) == ([], 64)
