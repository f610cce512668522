"""Metrics: a recorded flight becomes one number with a unit.

A metric that ships is a row of the table METRICS in `flight`, `control`, `link` or `mission`: name,
unit, meaning, and the function that computes it. A metric of your own is one Python file with

- a docstring, whose first line says in one sentence what the number is: the report prints it;
- `UNIT`, an SI unit as text: "s", "m", "m/s", "N", or "1" for counts and shares;
- `measure(flight: Flight) -> float | None`, which returns None if the number cannot be known.

Name the file in an experiment (`report.metrics`), or name its module in the entry-point group
`cloudrc.metrics` of a package: installed metrics are in every report.
"""

from __future__ import annotations

import inspect
from collections.abc import Iterable
from dataclasses import dataclass
from math import isfinite
from pathlib import Path

from cloudrc import plugins
from cloudrc.errors import BadInputError
from cloudrc.metrics import control, link, mission
from cloudrc.metrics import flight as motion
from cloudrc.metrics.flight import Flight, Metric

__all__ = [
    "METRIC_NOTE",
    "SHIPPED",
    "Flight",
    "Metric",
    "Number",
    "check",
    "find",
    "measure_all",
    "name_of",
    "not_measured",
]


METRIC_NOTE = "metric "
"""How a note on a metric begins."""
SHIPPED = {
    metric.name: metric
    for metric in (*motion.METRICS, *control.METRICS, *link.METRICS, *mission.METRICS)
}
"""Metrics that ship, by name."""


@dataclass(frozen=True, slots=True)
class Number:
    """One measured number.

    Attributes:
        value: Finite, in `unit`.
        unit: SI, as text; "1" for counts and shares.
        meaning: One sentence.
    """

    value: float
    unit: str
    meaning: str


def find(choice: str) -> Metric:
    """Find a metric.

    Args:
        choice: Name of a shipped or installed metric, or path of a Python file, which is run.

    Raises:
        BadInputError: If there is none, or what is there is no metric.
    """
    if choice in SHIPPED:
        return SHIPPED[choice]
    known = [*SHIPPED, *plugins.names("metrics")]
    name, is_path = name_of(choice), plugins.is_path(choice)
    if not is_path and name not in known:
        raise BadInputError(plugins.unknown("metric", choice, sorted(known)))
    if is_path and name in known:
        raise BadInputError(f"metric {choice!r}: {name} is a metric already; rename the file")
    found = plugins.find("metrics", choice)
    unit, measure = getattr(found, "UNIT", None), getattr(found, "measure", None)
    if not isinstance(unit, str) or not callable(measure):
        raise BadInputError(
            f"metric {choice!r} needs a text UNIT and a function measure(flight); write both"
        )
    return Metric(name, unit, (inspect.getdoc(found) or "").partition("\n")[0], measure)


def name_of(choice: str) -> str:
    """Give the name of a metric in report.json: a file's name without `.py`, or its own."""
    return Path(choice).stem if plugins.is_path(choice) else choice


def check(own: Iterable[str]) -> None:
    """Refuse metrics that cannot be used, before a flight is spent on them.

    Args:
        own: Names or paths, as for `find`.

    Raises:
        BadInputError: For the first one that is wrong, or if two have the same name.
    """
    found: dict[str, str] = {}
    for choice in own:
        name = find(choice).name
        if name in found:
            raise BadInputError(f"metrics {found[name]!r} and {choice!r} are both named {name}")
        found[name] = choice


def not_measured(asked: Iterable[str], own: Iterable[str]) -> list[str]:
    """Write a note for each file that an experiment asks for and that is not in `own`."""
    names = set(map(name_of, own))
    return [
        f"{METRIC_NOTE}{name_of(choice)} is not measured: name its file with --metric"
        for choice in asked
        if plugins.is_path(choice) and name_of(choice) not in names
    ]


def measure_all(flight: Flight, own: Iterable[str] = ()) -> tuple[dict[str, Number], list[str]]:
    """Measure everything that there is a metric for.

    Args:
        flight: A recorded flight.
        own: More metrics than the shipped and installed ones, as for `find`.

    Returns:
        Number by name, sorted, without those that cannot be known; and a note for each metric that
        failed. A user's metric may raise: this costs its own number, never the report.
    """
    numbers: dict[str, Number] = {}
    notes: list[str] = []
    for choice in sorted({*SHIPPED, *plugins.names("metrics"), *own}, key=name_of):
        name = name_of(choice)
        try:
            metric = find(choice)
            measured = metric.measure(flight)
            value = None if measured is None else float(measured)
        except Exception as error:
            notes.append(f"{METRIC_NOTE}{name} failed: {type(error).__name__}: {error}")
            continue
        if value is None:
            continue
        if isfinite(value):
            numbers[name] = Number(value, metric.unit, metric.meaning)
        else:
            notes.append(f"{METRIC_NOTE}{name} gave {value}: left out")
    return numbers, notes
