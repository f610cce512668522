"""One-way delay from cloud to world: mean over all datagrams that arrived, late ones included."""

from __future__ import annotations

from cloudrc.metrics import Flight
from cloudrc.metrics._statistics import mean

UNIT = "s"


def measure(flight: Flight) -> float | None:
    """Mean [s]; None where the two ends could not prove that they share a clock."""
    return mean(flight.during("/downlink_delay")["delay"])
