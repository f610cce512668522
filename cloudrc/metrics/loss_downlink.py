"""Share of the datagrams from cloud to world that never arrived."""

from __future__ import annotations

from cloudrc.metrics import Flight
from cloudrc.metrics._link import loss

UNIT = "1"


def measure(flight: Flight) -> float | None:
    """Lost by sent [1], up to the last that arrived."""
    return loss(flight, "/downlink_delay")
