# SPDX-License-Identifier: Apache-2.0

"""The named faults: each passes, and fails if its promise is broken."""

import pytest

from cloudrc.faults.measures import Requirement
from cloudrc.faults.scenarios import SCENARIOS
from cloudrc.faults.search import run_fault
from tests.conftest import nightly

QUICK = "world-restarted"


@pytest.mark.parametrize("name", [QUICK, *nightly(*sorted(SCENARIOS.keys() - {QUICK}))])
def test_a_fault_passes_its_checks(name):
    outcome = run_fault(name, 2)
    assert [check.show() for check in outcome.checks if not check.passed] == []
    assert outcome.passed, outcome.error


@pytest.mark.parametrize(
    ("name", "broken", "value", "said"),
    [
        ("cloud-killed", "guard.state.SETTLE_NS", 3 * 10**9, "TRACK again after its start"),
        ("swizzle-clog", "endpoint.REAL_TIME_FACTOR_MIN", 0.0, "times that world reports: late"),
    ],
)
def test_only_the_checks_of_a_broken_promise_fail(name, broken, value, said, monkeypatch):
    monkeypatch.setattr(f"cloudrc.world.{broken}", value)
    failed = [check.text for check in run_fault(name, 1).checks if not check.passed]
    assert failed[-1] == said
    assert set(failed) <= {said, "the new process commands after"}


@pytest.mark.parametrize("measured", [float("inf"), float("nan")])
def test_what_was_not_measured_passes_no_check(measured):
    assert not Requirement("late", measured, ">=", 1.0).passed
