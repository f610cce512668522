"""The named faults: each passes, and fails if its promise is broken."""

import pytest

from cloudrc.faults.scenarios import SCENARIOS
from cloudrc.faults.search import run_fault
from tests.conftest import nightly

QUICK = "cloud-killed", "world-restarted"


@pytest.mark.parametrize("name", [*QUICK, *nightly(*sorted(SCENARIOS.keys() - set(QUICK)))])
def test_a_fault_passes_its_checks(name):
    outcome = run_fault(name, 2)
    assert [check.show() for check in outcome.checks if not check.passed] == []
    assert outcome.passed, outcome.error


@pytest.mark.parametrize(
    ("name", "broken", "value", "said"),
    [
        (
            "cloud-killed",
            "cloudrc.world.guard.state.SETTLE_NS",
            3 * 10**9,
            "TRACK again after its start",
        ),
        (
            "swizzle-clog",
            "cloudrc.world.endpoint.REAL_TIME_FACTOR_MIN",
            0.0,
            "times that world reports",
        ),
    ],
)
def test_a_check_fails_if_its_promise_is_broken(name, broken, value, said, monkeypatch):
    monkeypatch.setattr(broken, value)
    failed = [check.text for check in run_fault(name, 1).checks if not check.passed]
    assert any(said in text for text in failed)
