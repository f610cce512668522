"""How late the relay released datagrams from cloud to world: median."""

from __future__ import annotations

from cloudrc.metrics import Flight
from cloudrc.metrics._relay import told

UNIT = "s"


def measure(flight: Flight) -> float | None:
    """Since the relay began [s]; None where none shaped."""
    return told(flight, "downlink_release_error_p50_ns", 1e-9)
