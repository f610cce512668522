"""How much time world's clock lost against its machine's because the simulation was late."""

from __future__ import annotations

from cloudrc.metrics import Flight
from cloudrc.metrics._wakes import slip

UNIT = "s"


def measure(flight: Flight) -> float | None:
    """Slip at the end minus slip at the start [s]; real time only."""
    return slip(flight)
