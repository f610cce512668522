"""How many of the mission's waypoints were reached, each within its tolerance for its dwell."""

from __future__ import annotations

import numpy as np

from cloudrc.metrics import Flight

UNIT = "1"


def measure(flight: Flight) -> float | None:
    """Count of different waypoints with an event "reached" [1]."""
    if flight.start_ns is None:
        return None
    mission = flight.during("/mission")
    return float(len(np.unique(mission["waypoint"][mission["event"] == "reached"])))
