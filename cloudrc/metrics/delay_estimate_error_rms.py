"""Difference between the horizon and the time that really passed until the command was applied.

RMS over all commands applied. The time that passed runs from the measurement to the first tick of
the low-level controller that uses the command, all on world's clock.
"""

from __future__ import annotations

from cloudrc.metrics import Flight
from cloudrc.metrics._statistics import rms

UNIT = "s"


def measure(flight: Flight) -> float | None:
    """RMS of horizon minus (application minus measurement) [s]."""
    applied = flight.applied
    return rms(applied.horizon - (applied.stamp_ns - applied.basis_stamp_ns) * 1e-9)
