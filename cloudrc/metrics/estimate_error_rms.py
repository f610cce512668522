"""Distance between cloud's estimate and the true position at the instant that it is meant for.

RMS over all control periods. It judges the predictor alone: the instant meant is the odometry's
stamp plus the horizon, right or wrong.
"""

from __future__ import annotations

import numpy as np

from cloudrc.metrics import Flight
from cloudrc.metrics._statistics import rms

UNIT = "m"


def measure(flight: Flight) -> float | None:
    """RMS length of estimated minus true position [m]."""
    control = flight.control
    meant_ns = control["basis_stamp_ns"] + np.rint(control["horizon"] * 1e9).astype(np.int64)
    return rms(control["position"] - flight.true_position(meant_ns))
