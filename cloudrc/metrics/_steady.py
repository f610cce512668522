"""The steady error of a hover: how far the robot stays from a setpoint that does not move."""

from __future__ import annotations

import numpy as np

from cloudrc.metrics._flight import Flight

WINDOW_NS = 5_000_000_000
"""The last part of the flight, over which it is averaged [ns]."""
SETTLING_NS = 10_000_000_000
"""How long the setpoint must have stood still before that [ns]. Source: docs/reference/control.md,
"Steady state": the slowest variant that settles needs 8 to 15 s to stay within 1 cm."""


def steady_error(flight: Flight, axis: int) -> float | None:
    """Average the distance of the true position from the setpoint along one axis.

    Args:
        flight: Of any kind.
        axis: 0, 1 or 2 for x, y or z, world frame.

    Returns:
        Mean of the absolute error [m] over the last 5 s; None unless the setpoint stood still over
        them and the 10 s before, with nothing touching the arm.
    """
    control = flight.control
    if flight.end_ns is None or flight.start_ns is None:
        return None
    begin_ns = flight.end_ns - WINDOW_NS
    still = control["setpoint"][control["stamp_ns"] >= begin_ns - SETTLING_NS]
    force = flight.during("/contact_force")
    touched = (force["tip_force"][force["stamp_ns"] >= begin_ns - SETTLING_NS] > 0).any()
    too_short = begin_ns - SETTLING_NS < flight.start_ns
    if too_short or touched or not len(still) or (still != still[-1]).any():
        return None
    truth = flight.truth
    rows = truth["stamp_ns"] >= begin_ns
    return float(np.abs(truth["position"][rows, axis] - still[-1, axis]).mean())
