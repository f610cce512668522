# SPDX-License-Identifier: Apache-2.0

"""The named faults: each passes, and fails if its promise is broken."""

import pytest

from tests.faults.measures import Requirement
from tests.faults.scenarios import SCENARIOS
from tools import faults

pytestmark = pytest.mark.usefixtures("shared_files")

QUICK = "world-restarted"


def marked(scenario):
    """Return a fault as a value of a parametrized test; only `QUICK` is injected daily."""
    told = {"injects": scenario.injects, "expects": scenario.expects}
    marks = [pytest.mark.fault(scenario.number, scenario.name, **told)]
    marks += [] if scenario.name == QUICK else [pytest.mark.full]
    return pytest.param(scenario, id=f"{scenario.id}-{scenario.name}", marks=marks)


@pytest.mark.parametrize("scenario", [*map(marked, SCENARIOS.values())])
def test_a_fault_passes_its_checks(scenario, fault_seed, record_property):
    outcome = scenario.run(fault_seed)
    record_property("records_sha256", outcome.sha256)
    for check in outcome.checks:
        record_property(check.text, check.shown)
    assert [check.show() for check in outcome.checks if not check.passed] == []
    assert outcome.checks


@pytest.mark.parametrize(
    ("name", "broken", "value", "said"),
    [
        ("cloud-killed", "guard.state.SETTLE_NS", 3 * 10**9, "TRACK again after its start"),
        ("swizzle-clog", "endpoint.REAL_TIME_FACTOR_MIN", 0.0, "times that world reports: late"),
    ],
)
def test_only_the_checks_of_a_broken_promise_fail(name, broken, value, said, monkeypatch):
    monkeypatch.setattr(f"cloudrc.world.{broken}", value)
    outcome = SCENARIOS[name].run(1)
    failed = [check.text for check in outcome.checks if not check.passed]
    assert failed[-1] == said
    assert set(failed) <= {said, "the new process commands after"}


def test_every_number_has_a_test():
    assert faults.numbers() == set(range(1, faults.LAST + 1))


@pytest.mark.parametrize("measured", [float("inf"), float("nan")])
def test_what_was_not_measured_passes_no_check(measured):
    assert not Requirement("late", measured, ">=", 1.0).passed
