"""How many faults were noted that did not stop the flight: a predictor that raised, a clamp."""

from __future__ import annotations

from cloudrc.metrics import Flight

UNIT = "1"


def measure(flight: Flight) -> float | None:
    """Count of /fault during the flight [1]; None where nothing was flown."""
    return None if flight.start_ns is None else float(len(flight.during("/fault")["code"]))
