"""How late world's process woke up for its deadlines: 99th percentile; real time only."""

from __future__ import annotations

from cloudrc.metrics import Flight
from cloudrc.metrics._statistics import percentile
from cloudrc.metrics._wakes import wakes

UNIT = "s"


def measure(flight: Flight) -> float | None:
    """99th percentile over the wakes [s]."""
    return percentile(wakes(flight, "world")["lateness"], 99.0)
