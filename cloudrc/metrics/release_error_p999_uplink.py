"""How late the relay released datagrams from world to cloud: 99.9th percentile."""

from __future__ import annotations

from cloudrc.metrics import Flight
from cloudrc.metrics._relay import told

UNIT = "s"


def measure(flight: Flight) -> float | None:
    """Since the relay began [s]; None where none shaped."""
    return told(flight, "uplink_release_error_p999_ns", 1e-9)
