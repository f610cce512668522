"""Metrics: a recorded flight becomes one number with a unit; one file each, found by its name.

A metric's file has

- a docstring whose first line says in one sentence what the number is: the report prints it;
- `UNIT`, an SI unit as text: "s", "m", "m/s", "N", or "1" for counts and shares;
- `measure(flight: Flight) -> float | None`, which returns None where the number cannot be known.

Files whose name begins with an underscore are shared by metrics and are none themselves.
"""

from __future__ import annotations

import inspect
from dataclasses import dataclass
from math import isfinite

from cloudrc import plugins
from cloudrc.metrics._flight import Flight

__all__ = ["METRIC_NOTE", "Flight", "Number", "measure_all"]


METRIC_NOTE = "metric "
"""How a note on a metric begins."""


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


def measure_all(flight: Flight) -> tuple[dict[str, Number], list[str]]:
    """Measure everything that there is a metric for.

    Args:
        flight: A recorded flight.

    Returns:
        Number by name, those that cannot be known left out; and a note for each metric that failed.
        A stranger's metric may raise: it costs its own number, never the report.
    """
    numbers: dict[str, Number] = {}
    notes: list[str] = []
    for name in plugins.names("metrics"):
        try:
            metric = plugins.find("metrics", name)
            value, unit = metric.measure(flight), str(metric.UNIT)
            meaning = (inspect.getdoc(metric) or "").partition("\n")[0]
        except Exception as error:
            notes.append(f"{METRIC_NOTE}{name} failed: {type(error).__name__}: {error}")
            continue
        if value is None:
            continue
        if isfinite(value):
            numbers[name] = Number(float(value), unit, meaning)
        else:
            notes.append(f"{METRIC_NOTE}{name} gave {value}: left out")
    return numbers, notes
