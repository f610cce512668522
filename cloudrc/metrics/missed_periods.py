"""How many periods of 10 ms cloud let pass without a command, being busy; real time only."""

from __future__ import annotations

from cloudrc.metrics import Flight

UNIT = "1"


def measure(flight: Flight) -> float | None:
    """Last count of cloud's missed periods [1]; None in virtual time, where nothing takes time."""
    if not len(flight.recording["/lateness"]):
        return None
    count = flight.recording["/count"]
    missed = count["total"][count["name"] == "missed_periods"]
    return float(missed[-1]) if len(missed) else 0.0
