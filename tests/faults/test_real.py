"""The faults that make sense with real processes, on this machine and in a cluster."""

from __future__ import annotations

import json
import subprocess
import sys

import pytest

from cloudrc.faults.catalogue import scenarios
from cloudrc.faults.scenario import Scenario

REAL = scenarios("real")


@pytest.mark.process
@pytest.mark.full
@pytest.mark.parametrize("scenario", REAL, ids=lambda each: each.name)
def test_a_fault_with_real_processes_is_survived(scenario: Scenario) -> None:
    outcome = scenario.run(1)
    if outcome.skipped:
        pytest.skip(outcome.skipped)
    assert [check.show() for check in outcome.checks if not check.passed] == []


def test_what_is_listed_for_a_mode_can_be_run_there() -> None:
    for flag, mode in (("--real", "real"), ("--cluster", "cluster")):
        command = [sys.executable, "-m", "cloudrc", "faults", "list", flag, "-o", "json"]
        listed = json.loads(subprocess.run(command, capture_output=True, check=True).stdout)
        assert [each["name"] for each in listed] == [each.name for each in scenarios(mode)]  # type: ignore[arg-type]
        assert {each["mode"] for each in listed} == {mode}
