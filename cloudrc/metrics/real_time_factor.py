"""Time that passed in the simulation by time that passed on the machine; real time only.

1 is what it has to be. Below, the simulated robot was slower than the network it was flown over.
"""

from __future__ import annotations

from cloudrc.metrics import Flight
from cloudrc.metrics._wakes import slip

UNIT = "1"


def measure(flight: Flight) -> float | None:
    """Simulated time by simulated time plus slip [1]."""
    slipped = slip(flight)
    if slipped is None or not flight.end_ns:
        return None
    simulated = float(flight.seconds(flight.end_ns))
    return simulated / (simulated + slipped) if simulated > 0 else None
