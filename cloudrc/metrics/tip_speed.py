"""Speed of the arm's tip just before it first touches the board."""

from __future__ import annotations

import numpy as np

from cloudrc.metrics import Flight
from cloudrc.metrics._contact import first_touch

UNIT = "m/s"


def measure(flight: Flight) -> float | None:
    """Length of the tip's velocity [m/s]."""
    touch = first_touch(flight)
    return None if touch is None else float(np.linalg.norm(touch["tip_velocity"]))
