"""Round trip from command to echo, hold included: mean of the paper's tau_n."""

from __future__ import annotations

from cloudrc.metrics import Flight
from cloudrc.metrics._round_trip import round_trips
from cloudrc.metrics._statistics import mean

UNIT = "s"


def measure(flight: Flight) -> float | None:
    """Mean over the echoes [s]."""
    return mean(round_trips(flight)["loop_delay"])
