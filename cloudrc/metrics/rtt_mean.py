"""Round trip from command to echo, the time that world held the command excluded: mean.

It describes the commands that were applied. Under newest-wins these are the quick ones, so it
reads lower than the link profile; the link itself is judged by the one-way delays.
"""

from __future__ import annotations

from cloudrc.metrics import Flight
from cloudrc.metrics._round_trip import round_trips
from cloudrc.metrics._statistics import mean

UNIT = "s"


def measure(flight: Flight) -> float | None:
    """Mean over the echoes [s]."""
    return mean(round_trips(flight)["rtt"])
