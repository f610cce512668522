"""The named faults: each passes, and fails if its promise is broken."""

import pytest

from cloudrc.faults.scenarios import SCENARIOS, find
from tests.conftest import nightly

QUICK = ("F6", "F13", "F17", "F40")


@pytest.mark.parametrize(
    "scenario",
    [
        *(each for each in SCENARIOS if each.id in QUICK),
        *nightly(*(each for each in SCENARIOS if each.id not in QUICK)),
    ],
    ids=lambda each: each.name,
)
def test_a_fault_passes_its_checks(scenario):
    outcome = scenario.run(2)
    assert [check.show() for check in outcome.checks if not check.passed] == []
    assert outcome.passed, outcome.error


@pytest.mark.parametrize(
    ("name", "broken", "value", "said"),
    [
        ("F13", "cloudrc.world.guard.state.SETTLE_NS", 3 * 10**9, "TRACK again after its start"),
        ("F40", "cloudrc.world.endpoint.REAL_TIME_FACTOR_MIN", 0.0, "times that world reports"),
        ("F13", "cloudrc.faults.motion_checks.SLACK", -1.0, "breaches of an invariant"),
    ],
)
def test_a_check_fails_if_its_promise_is_broken(name, broken, value, said, monkeypatch):
    monkeypatch.setattr(broken, value)
    failed = [check.text for check in find(name).run(1).checks if not check.passed]
    assert any(said in text for text in failed)
