"""How long the guard flew by itself because no fresh command was there."""

from __future__ import annotations

from cloudrc.metrics import Flight
from cloudrc.metrics._hold import holds

UNIT = "s"


def measure(flight: Flight) -> float | None:
    """Sum of the HOLD intervals before the mission's end [s]; None where nothing was flown."""
    if flight.start_ns is None:
        return None
    return sum(end - start for start, end in holds(flight)) * 1e-9
