"""The summary of a run: verdict, main numbers, faults and exit code."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from cloudrc.cli.run import exit_code, main_numbers, show, verdict


def report(outcome: str, *failures: str, **numbers: tuple[float, str]) -> dict[str, Any]:
    return {
        "verdict": outcome,
        "failures": [{"code": "x", "text": text, "time": 3.25} for text in failures],
        "numbers": {name: {"value": v, "unit": u} for name, (v, u) in numbers.items()},
    }


@pytest.mark.parametrize(
    ("outcome", "code"),
    [("success", 0), ("failure", 1), ("invalid", 6), ("interrupted", 130)],
)
def test_each_verdict_has_its_exit_code(outcome: str, code: int) -> None:
    assert exit_code(report(outcome)) == code


def test_every_failure_is_printed() -> None:
    text = verdict(report("failure", "the robot touched pipe_2", "too slow"))
    assert text == "FAILURE: the robot touched pipe_2\n  also: too slow (at 3.25 s)"


def test_numbers_have_handy_units_and_unknown_ones_are_absent() -> None:
    text = main_numbers(report("success", duration=(30.9, "s"), rtt_mean=(0.0697, "s")))
    assert [line.split()[-2:] for line in text.splitlines()] == [["30.90", "s"], ["69.70", "ms"]]


def test_faults_are_mentioned(capsys: pytest.CaptureFixture[str]) -> None:
    show(report("success", fault_count=(0.0, "1")), Path("runs/a"))
    assert "faults" not in capsys.readouterr().out
    show(report("success", fault_count=(41.0, "1")), Path("runs/a"))
    lines = capsys.readouterr().out.splitlines()
    assert "  faults noted in flight: 41, see the report" in lines
    assert lines[-1] == "runs/a/report.html"
