# SPDX-License-Identifier: Apache-2.0

"""The search for faults: what it counts and stores, and what an interrupt leaves."""

import json
import os
import signal
from pathlib import Path

import pytest

from cloudrc.flight.trials.workers import WorkerDiedError
from tests.faults.__main__ import main
from tests.faults.rules import Breach
from tests.faults.schedule import Schedule, load
from tests.faults.trial import TrialResult


@pytest.fixture
def search(capsys, tmp_path, monkeypatch):
    """Return a function that searches in an empty folder: search(flags) returns what it prints."""
    monkeypatch.chdir(tmp_path)

    def run(*flags, code=0):
        assert main(["--json", *flags]) == code
        out, error = capsys.readouterr()
        return json.loads(out), error

    return run


def test_what_was_flown_before_a_worker_died_is_kept(search, monkeypatch):
    def flown(function, work, jobs):
        yield TrialResult(Schedule(1), ())
        raise WorkerDiedError("a worker was killed")

    monkeypatch.setattr("tests.faults.search.map_in_order", flown)
    found, error = search("--jobs", "2", code=6)
    assert found["count"] == 1
    assert error.endswith("a worker was killed; to continue, add --first 2\n")


BAD, INTERRUPTED = 5, 9
"""Seeds whose schedule fails, and in whose flight the search is interrupted."""


@pytest.fixture
def find(monkeypatch, search):
    """Search with a number of flights that take no time; return the document and stderr."""

    def run(count, *flags, code=0):
        def fly(schedule):
            clock[0] += 60.0 / count
            if schedule.seed == INTERRUPTED:
                os.kill(os.getpid(), signal.SIGTERM)
            breaches = (Breach(1.0, "stuck", "not flown"),) if schedule.seed == BAD else ()
            return TrialResult(schedule, breaches, "", 1.0 / (1 + schedule.seed), 2.0, 2)

        clock = [0.0]
        monkeypatch.setattr("tests.faults.trial.fly", fly)
        monkeypatch.setattr("tests.faults.search.time.monotonic", lambda: clock[0])
        return search(*flags, code=code)

    return run


@pytest.mark.child
def test_a_search_counts_stores_and_can_continue(find):
    told, _ = find(3)
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
    assert "to continue, add --first 9" in error
    told, _ = find(1, "--hostile")
    assert (told["kind"], told["count"]) == ("hostile", 1)
    assert [told["invariants"][name]["judged"] for name in ("collision", "fence")] == [0, 1]
