"""Length of the way that the robot's base has flown."""

from __future__ import annotations

import numpy as np

from cloudrc.metrics import Flight

UNIT = "m"


def measure(flight: Flight) -> float | None:
    """Sum of the steps between true positions [m]."""
    steps = np.diff(flight.truth["position"], axis=0)
    return float(np.linalg.norm(steps, axis=1).sum()) if len(steps) else None
