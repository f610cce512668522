"""Datagrams from world to cloud that the relay had no room for."""

from __future__ import annotations

from cloudrc.metrics import Flight
from cloudrc.metrics._relay import told

UNIT = "1"


def measure(flight: Flight) -> float | None:
    """Since the relay began [1]; None where none shaped."""
    return told(flight, "uplink_overflow")
