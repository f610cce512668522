"""Smallest distance between the robot and a pipe's wall while its base is inside a pipe."""

from __future__ import annotations

from cloudrc.metrics import Flight

UNIT = "m"


def measure(flight: Flight) -> float | None:
    """Minimum over the samples inside a pipe [m]; negative if a wall was penetrated."""
    inside = flight.clearance[flight.inside]
    return float(inside.min()) if len(inside) else None
