"""Age of the newest odometry that cloud has when it computes a command: mean.

Known only where both ends prove that they share a clock, which shows in the one-way delays.
"""

from __future__ import annotations

import numpy as np

from cloudrc.metrics import Flight
from cloudrc.metrics._statistics import mean

UNIT = "s"


def measure(flight: Flight) -> float | None:
    """Mean of now minus the odometry's stamp over all control periods [s]."""
    if not np.isfinite(flight.during("/uplink_delay")["delay"]).any():
        return None
    return mean((flight.control["stamp_ns"] - flight.control["basis_stamp_ns"]) * 1e-9)
