"""The faults that make sense with real processes, on this machine and in a cluster."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from cloudrc.errors import BadInputError
from cloudrc.faults.cluster import pods
from cloudrc.faults.real.wire import FLOOD_SECONDS, flood_seconds
from cloudrc.faults.scenario import Outcome, Scenario, find, scenarios
from cloudrc.messages import GuardState

REAL = scenarios("real")
QUICK = ("recorder-killed",)
"""Takes seconds: it passes before anything lands; the others run nightly."""


def named(scenario: Scenario) -> str:
    return scenario.name


def survived(outcome: Outcome) -> bool:
    assert [check.show() for check in outcome.checks if not check.passed] == []
    return outcome.passed


@pytest.mark.process
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


@pytest.mark.parametrize(("told", "seconds"), [(None, 20), ("600", 600)])
def test_a_flood_lasts_as_long_as_the_environment_says(
    told: str | None, seconds: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.delenv(FLOOD_SECONDS, raising=False)
    if told is not None:
        monkeypatch.setenv(FLOOD_SECONDS, told)
    assert flood_seconds() == seconds


@pytest.mark.parametrize("told", ["", "0", "-1", "1.5", "10 min"])
def test_and_not_for_what_is_no_number_of_seconds(
    told: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv(FLOOD_SECONDS, told)
    with pytest.raises(BadInputError, match="give whole seconds, such as 600"):
        flood_seconds()


KUBECTL = """#!/bin/sh
case "$*" in
*logs*) echo waypoint 2 of 7 reached; while [ ! -e {gone} ]; do sleep 0.02; done; echo "{word}" ;;
*delete*) touch {gone} ;;
esac
"""


@pytest.mark.process
@pytest.mark.parametrize(
    ("word", "heard"), [("INTERRUPTED: the Job was stopped", True), ("waypoint 3 of 7", False)]
)
def test_the_last_word_of_a_job_is_heard_while_its_pod_goes(
    word: str, heard: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """By a kubectl that says it once the pod is deleted, and never again."""
    kubectl = tmp_path / "kubectl"
    kubectl.write_text(KUBECTL.format(gone=tmp_path / "gone", word=word))
    kubectl.chmod(0o755)
    monkeypatch.setenv("PATH", str(tmp_path), prepend=":")
    there: dict[str, Any] = {
        "release_there": lambda: SimpleNamespace(flags=["--namespace=x"]),
        "flying": lambda release, number: "job",
        "until": lambda text, condition, limit: 0.0,
        "guard": lambda release: GuardState.HOLD,
        "finish": lambda outcome, release, name: None,
        "list_pods": lambda release, component: ["world"],
    }
    for name, stand_in in there.items():
        monkeypatch.setattr(pods, name, stand_in)
    outcome = find("F33", "cluster").run(1)
    assert [check.show() for check in outcome.checks if not check.passed] == (
        [] if heard else ["the Job ends with INTERRUPTED: NO"]
    )
