"""Summary of a run: its verdict, main numbers and exit code."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from cloudrc.cli.output import escape, paint, print_line, table
from cloudrc.metrics.verdict import EXIT_CODES

COLOURS = {"success": "green", "failure": "red", "invalid": "yellow", "interrupted": "yellow"}

# The most important numbers -> their labels; report.html and report.json show all numbers.
MAIN = {
    "duration": "mission took",
    "contact_time": "arm touches the board at",
    "tip_speed": "with the tip at",
    "steady_contact_force": "and then presses with",
    "min_clearance": "least clearance in the pipes",
    "rtt_mean": "round trip, mean",
    "prediction_error_rms": "prediction error, RMS",
    "hold_count": "times in HOLD",
    "real_time_factor": "real-time factor",
}


def exit_code(report: Mapping[str, Any]) -> int:
    """Give the exit code of a report's verdict."""
    return EXIT_CODES[report["verdict"]]


def show(report: Mapping[str, Any], folder: Path) -> None:
    """Print the verdict, the main numbers and, on the last line, the report's path."""
    print()
    print(verdict(report))
    print()
    print(main_numbers(report))
    faults = report["numbers"].get("fault_count", {"value": 0})["value"]
    if faults:
        print(paint(f"  faults noted in flight: {faults:.0f}, see the report", "yellow"))
    print()
    print_line(str(folder / "report.html"))


def verdict(report: Mapping[str, Any]) -> str:
    """Give the verdict with the first failure; further failures follow, one a line."""
    outcome = report["verdict"]
    word = paint(outcome.upper(), COLOURS[outcome])
    failures = report["failures"]
    if not failures:
        return f"{word}: every waypoint reached, every criterion met"
    first, *others = failures
    return "\n".join([f"{word}: {escape(first['text'])}", *map(_further_failure, others)])


def _further_failure(failure: Mapping[str, Any]) -> str:
    time = failure.get("time")
    when = f" (at {time:.2f} s)" if time is not None else ""
    return escape(f"  also: {failure['text']}{when}")


def main_numbers(report: Mapping[str, Any]) -> str:
    """Lay out the main numbers as a table, without those that are unknown."""
    numbers = report["numbers"]
    rows = [
        (f"  {label}", *_cells(name, numbers[name]))
        for name, label in MAIN.items()
        if name in numbers
    ]
    return table(rows, right=[1]) if rows else "  no numbers: nothing was flown"


def _cells(name: str, entry: Mapping[str, Any]) -> tuple[str, str]:
    from cloudrc.metrics import Number
    from cloudrc.report.numbers import readable

    return readable(name, Number(entry["value"], entry["unit"], ""))
