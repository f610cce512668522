"""How often the guard took over because no fresh command was there."""

from __future__ import annotations

from cloudrc.metrics import Flight
from cloudrc.metrics._hold import holds

UNIT = "1"


def measure(flight: Flight) -> float | None:
    """Count of HOLD intervals before the mission's end [1]; None where nothing was flown."""
    return None if flight.start_ns is None else float(len(holds(flight)))
