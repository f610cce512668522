"""Largest true speed of the robot's base."""

from __future__ import annotations

import numpy as np

from cloudrc.metrics import Flight

UNIT = "m/s"


def measure(flight: Flight) -> float | None:
    """Maximum length of the velocity [m/s]."""
    speeds = np.linalg.norm(flight.truth["velocity"], axis=1)
    return float(speeds.max()) if len(speeds) else None
