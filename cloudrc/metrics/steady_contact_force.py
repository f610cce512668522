"""Force on the arm's tip once it presses steadily: mean over the last 2 s of the mission.

Known only where the mission was flown to its end and the tip touched the board. The peak at
impact depends on the simulator's contact parameters, the steady force does not.
"""

from __future__ import annotations

from cloudrc.metrics import Flight
from cloudrc.metrics._contact import first_touch
from cloudrc.metrics._statistics import mean

UNIT = "N"
WINDOW_NS = 2_000_000_000
"""The last part of the dwell at the board [ns]."""


def measure(flight: Flight) -> float | None:
    """Mean of the touch sensor [N]."""
    touch = first_touch(flight)
    if touch is None or flight.ending is None or flight.ending[1] != "done":
        return None
    begin_ns = flight.ending[0] - WINDOW_NS
    if touch["stamp_ns"] > begin_ns:
        return None
    force = flight.during("/contact_force")
    return mean(force["tip_force"][force["stamp_ns"] >= begin_ns])
