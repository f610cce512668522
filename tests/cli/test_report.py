"""The summary of a run: verdict, main numbers, faults and exit code."""

from pathlib import Path

import pytest

from cloudrc.cli.report import summary
from cloudrc.metrics.verdict import EXIT_CODES


def report(outcome, *failures, **numbers):
    return {
        "verdict": outcome,
        "failures": [{"code": "x", "text": text, "time": 3.25} for text in failures],
        "numbers": {name: {"value": v, "unit": u} for name, (v, u) in numbers.items()},
    }


@pytest.mark.parametrize(
    ("found", "code", "lines"),
    [
        (
            report("success", duration=(30.9, "s"), rtt_mean=(0.0697, "s"), fault_count=(0.0, "1")),
            0,
            [
                "SUCCESS: every waypoint reached, every criterion met",
                "mission took 30.90 s",
                "round trip, mean 69.70 ms",
            ],
        ),
        (
            report("failure", "the robot touched pipe_2", "too slow", fault_count=(41.0, "1")),
            1,
            [
                "FAILURE: the robot touched pipe_2",
                "also: too slow (at 3.25 s)",
                "no numbers: nothing was flown",
                "faults noted in flight: 41, see the report",
            ],
        ),
        (report("invalid", "x"), 6, ["INVALID: x", "no numbers: nothing was flown"]),
        (report("interrupted", "x"), 130, ["INTERRUPTED: x", "no numbers: nothing was flown"]),
    ],
)
def test_summary(found, code, lines):
    shown = summary(found, Path("runs/a")).splitlines()
    assert [" ".join(line.split()) for line in shown if line] == [*lines, "runs/a/report.html"]
    assert EXIT_CODES[found["verdict"]] == code
