"""Time from the start of the mission to the arm's first touch of the board."""

from __future__ import annotations

from cloudrc.metrics import Flight
from cloudrc.metrics._contact import first_touch

UNIT = "s"


def measure(flight: Flight) -> float | None:
    """Stamp of the first touch, after the start [s]."""
    touch = first_touch(flight)
    return None if touch is None else float(flight.seconds(touch["stamp_ns"]))
