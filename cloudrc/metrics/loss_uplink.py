"""Share of the datagrams from world to cloud that never arrived."""

from __future__ import annotations

from cloudrc.metrics import Flight
from cloudrc.metrics._link import loss

UNIT = "1"


def measure(flight: Flight) -> float | None:
    """Lost by sent [1], up to the last that arrived."""
    return loss(flight, "/uplink_delay")
