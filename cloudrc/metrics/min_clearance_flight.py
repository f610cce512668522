"""Smallest distance between the robot and a pipe, inside or outside, from start to end.

The board does not count: it is there to be touched.
"""

from __future__ import annotations

from cloudrc.metrics import Flight

UNIT = "m"


def measure(flight: Flight) -> float | None:
    """Minimum over all samples [m]; negative if a wall was penetrated."""
    return float(flight.clearance.min()) if len(flight.clearance) else None
