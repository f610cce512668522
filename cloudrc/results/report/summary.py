# SPDX-License-Identifier: Apache-2.0

"""Summarize a report in a few lines of text."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any

from cloudrc.base.text import Paint, escape, plain, table
from cloudrc.results.metrics.flight import Metric
from cloudrc.results.metrics.measure import METRIC_NOTE, SHIPPED, Number, scale
from cloudrc.results.report.document import INCOMPLETE

SHARES = ("loss_", "late_", "overshoot_")
"""Prefixes of the names of metrics that readers see in per cent."""
NO_NUMBERS = {
    True: "  no numbers: nothing was flown",
    False: "  no numbers: the recording has lost the end of the flight",
}
"""Whether the recording is complete -> line in place of the numbers."""
COLOURS = {"success": "green", "failure": "red", "invalid": "yellow", "interrupted": "yellow"}


def summarize(report: Mapping[str, Any], paint: Paint = plain) -> str:
    """Summarize a report as text: verdict, failures, main numbers and warnings."""
    numbers = {
        name: Number(entry["value"], entry["unit"], "") for name, entry in report["numbers"].items()
    }
    rows = [(f"  {label}", digits, unit) for label, digits, unit in main_numbers(numbers)]
    shown = table(rows, right=[1]) if rows else NO_NUMBERS[report.get("complete", True)]
    return "\n".join([*_verdict(report, paint), "", shown, *_warnings(report, paint)])


def _verdict(report: Mapping[str, Any], paint: Paint) -> Iterable[str]:
    outcome, failures = report["verdict"], report["failures"]
    first = failures[0]["text"] if failures else f"{_goal(report)}, every criterion met"
    about = "" if report.get("complete", True) else " (recording incomplete)"
    yield f"{paint(outcome.upper(), COLOURS[outcome])}{about}: {escape(first)}"
    for failure in failures[1:]:
        when = f" (at {failure['time']:.2f} s)" if "time" in failure else ""
        yield escape(f"  also: {failure['text']}{when}")


def _goal(report: Mapping[str, Any]) -> str:
    """Return what the robot has done in a mission that succeeded."""
    if (end := report["numbers"].get("final_error")) is not None:
        return f"setpoints flown to their end, {end['value']:.2f} m from the last one"
    if (out := report["numbers"].get("out_of_view")) is not None:
        return f"flown to the end, the target out of view for {out['value']:.1%} of the time"
    return "every step flown" if "steps" in report else "every waypoint reached"


def _warnings(report: Mapping[str, Any], paint: Paint) -> Iterable[str]:
    for note in report.get("notes", ()):
        if note.startswith((METRIC_NOTE, INCOMPLETE)):
            yield paint(f"  {escape(note)}", "yellow")
    faults = report["numbers"].get("fault_count", {"value": 0})["value"]
    if faults:
        yield paint(f"  faults noted in flight: {faults:.0f}, see the report", "yellow")


def main_numbers(numbers: Mapping[str, Number]) -> list[tuple[str, str, str]]:
    """Return label, digits and unit of each number with a label that was measured.

    The metrics of the user and of installed packages follow, under their own names.
    """
    # A mission with a last setpoint has no waypoints.
    hidden = "waypoints_reached" if "final_error" in numbers else None
    labels = {
        metric.name: metric.label
        for metric in in_groups()
        if metric.label and metric.name != hidden
    }
    labels |= {name: name for name in sorted(numbers.keys() - SHIPPED)}
    return [
        (label, *readable(name, numbers[name])) for name, label in labels.items() if name in numbers
    ]


def in_groups() -> list[Metric]:
    """Return the metrics of cloudrc by their groups, in the order of the first of each group."""
    groups = dict.fromkeys(metric.group for metric in SHIPPED.values())
    return [metric for group in groups for metric in SHIPPED.values() if metric.group == group]


def readable(name: str, number: Number) -> tuple[str, str]:
    """Convert a value to a readable unit; return the digits and the unit as text."""
    value, (factor, unit) = number.value, scale(number.unit, abs(number.value))
    if value == 0:
        return "0", unit
    if unit:
        return _digits(value * factor), unit
    if name.startswith(SHARES):
        return f"{value * 100:.2f}", "%"
    return (f"{value:.0f}" if value.is_integer() else f"{value:.4g}"), ""


def _digits(value: float) -> str:
    """Format with four significant digits, but at most three decimals: 27.60, 0.237, 16.99."""
    places = 3 if abs(value) < 1 else 4 - len(str(int(abs(value))))
    return f"{value:.{max(places, 0)}f}"
