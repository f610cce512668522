"""How many commands reached the low-level controller."""

from __future__ import annotations

from cloudrc.metrics import Flight

UNIT = "1"


def measure(flight: Flight) -> float | None:
    """Count of /command_applied [1]; None where nothing was flown."""
    return (
        None if flight.start_ns is None else float(len(flight.during("/command_applied")["epoch"]))
    )
