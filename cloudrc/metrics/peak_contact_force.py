"""Largest force on the arm's tip, as sampled at 100 Hz.

It depends on the contact parameters of the simulator: compare it within one scene only.
"""

from __future__ import annotations

from cloudrc.metrics import Flight
from cloudrc.metrics._contact import first_touch

UNIT = "N"


def measure(flight: Flight) -> float | None:
    """Maximum of the touch sensor [N]; None if the board was never touched."""
    if first_touch(flight) is None:
        return None
    force = flight.during("/contact_force")["tip_force"]
    return float(force.max()) if len(force) else None
