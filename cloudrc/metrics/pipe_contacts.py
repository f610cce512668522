"""How often the robot began to touch a pipe."""

from __future__ import annotations

import numpy as np

from cloudrc.metrics import Flight

UNIT = "1"


def measure(flight: Flight) -> float | None:
    """Count of /contact with a pipe [1]; None where nothing was flown or there is no pipe."""
    if flight.start_ns is None or not flight.scene.pipes:
        return None
    bodies = flight.during("/contact")["body"]
    return float(np.sum([str(body).startswith("pipe") for body in bodies]))
