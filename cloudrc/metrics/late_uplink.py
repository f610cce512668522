"""Share of the datagrams from world to cloud that arrived but came too late to be used."""

from __future__ import annotations

from cloudrc.metrics import Flight
from cloudrc.metrics._link import late

UNIT = "1"


def measure(flight: Flight) -> float | None:
    """Unused by arrived [1]."""
    return late(flight, "/uplink_delay")
