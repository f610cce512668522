"""Distance between the setpoint and cloud's own estimate: RMS.

It is dominated by how far away the next waypoint is, and says nothing about how accurate the
estimate is; for that read estimate_error_rms.

Source: the paper, error figure.
"""

from __future__ import annotations

from cloudrc.metrics import Flight
from cloudrc.metrics._statistics import rms

UNIT = "m"


def measure(flight: Flight) -> float | None:
    """RMS length over all control periods [m]."""
    return rms(flight.control["setpoint"] - flight.control["position"])
