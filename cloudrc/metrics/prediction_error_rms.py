"""Distance between where cloud expected the robot and where it was when the command was applied.

RMS over all commands applied. It holds the predictor and the delay estimate to account together:
a command acts at the instant of its application, whatever instant it was computed for.

Source: docs/reference/control.md, "Predictors".
"""

from __future__ import annotations

from cloudrc.metrics import Flight
from cloudrc.metrics._statistics import rms

UNIT = "m"


def measure(flight: Flight) -> float | None:
    """RMS length of predicted minus true position [m]."""
    applied = flight.applied
    return rms(applied.predicted - flight.true_position(applied.stamp_ns))
