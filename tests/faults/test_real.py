"""The faults that make sense with real processes, on this machine and in a cluster."""

from __future__ import annotations

import json
import subprocess
import sys

import pytest

from cloudrc.faults.catalogue import scenarios
from cloudrc.faults.scenario import Outcome, Scenario

REAL = scenarios("real")
QUICK = ("cloud-killed", "recorder-killed", "slow-scrapers")
"""A flight each: they pass before anything lands; the others take minutes."""


def named(scenario: Scenario) -> str:
    return scenario.name


def survived(outcome: Outcome) -> bool:
    assert [check.show() for check in outcome.checks if not check.passed] == []
    return outcome.passed


@pytest.mark.process
@pytest.mark.promise("P-FAULT-1")
@pytest.mark.parametrize("scenario", [r for r in REAL if r.name in QUICK], ids=named)
def test_a_fault_with_real_processes_is_survived(scenario: Scenario) -> None:
    first = scenario.run(1)  # in real time, on a machine that does other things, too
    assert survived(first if first.passed else scenario.run(2))


@pytest.mark.full
@pytest.mark.process
@pytest.mark.parametrize("scenario", [r for r in REAL if r.name not in QUICK], ids=named)
def test_so_is_every_other_one_where_it_can_be_brought_about(scenario: Scenario) -> None:
    outcome = scenario.run(1)
    if outcome.skipped:
        pytest.skip(outcome.skipped)
    assert survived(outcome)


def test_what_is_listed_for_a_mode_can_be_run_there() -> None:
    for flag, mode in (("--real", "real"), ("--cluster", "cluster")):
        command = [sys.executable, "-m", "cloudrc", "faults", "list", flag, "-o", "json"]
        document = json.loads(subprocess.run(command, capture_output=True, check=True).stdout)
        assert document["schemaVersion"] == 1
        listed = document["faults"]
        assert [each["name"] for each in listed] == [each.name for each in scenarios(mode)]  # type: ignore[arg-type]
        assert {each["mode"] for each in listed} == {mode}
