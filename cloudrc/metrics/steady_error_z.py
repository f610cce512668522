"""Distance from a resting setpoint along z: mean over the last 5 s of a hover."""

from __future__ import annotations

from cloudrc.metrics import Flight
from cloudrc.metrics._steady import steady_error

UNIT = "m"


def measure(flight: Flight) -> float | None:
    """Mean of the absolute error [m]."""
    return steady_error(flight, axis=2)
