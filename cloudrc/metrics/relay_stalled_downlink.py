"""Datagrams from cloud to world that waited 50 ms or more for the relay to look at them."""

from __future__ import annotations

from cloudrc.metrics import Flight
from cloudrc.metrics._relay import told

UNIT = "1"


def measure(flight: Flight) -> float | None:
    """Since the relay began [1]; None where none shaped. They left later than its errors say."""
    return told(flight, "downlink_stalled")
