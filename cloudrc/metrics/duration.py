"""Time from the start of the mission to its end.

The start is the instant at which the guard first lets commands through; the end is the mission's
last event, or the end of the recording.
"""

from __future__ import annotations

from cloudrc.metrics import Flight

UNIT = "s"


def measure(flight: Flight) -> float | None:
    """End minus start [s]."""
    return None if flight.end_ns is None else float(flight.seconds(flight.end_ns))
