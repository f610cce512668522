"""Round trip from command to echo, hold excluded: 95th percentile."""

from __future__ import annotations

from cloudrc.metrics import Flight
from cloudrc.metrics._round_trip import round_trips
from cloudrc.metrics._statistics import percentile

UNIT = "s"


def measure(flight: Flight) -> float | None:
    """95th percentile over the echoes [s]."""
    return percentile(round_trips(flight)["rtt"], 95.0)
