"""Times at which the guard flew by itself, which several metrics and figures share."""

from __future__ import annotations

from cloudrc.messages import GuardState
from cloudrc.metrics._flight import Flight


def holds(flight: Flight) -> list[tuple[int, int]]:
    """List the intervals in HOLD during the flight.

    Returns:
        Start and end of each [ns], world's clock, in order.
    """
    if flight.end_ns is None:
        return []
    guard = flight.during("/guard")
    ends = [*guard["stamp_ns"][1:], flight.end_ns]
    return [
        (int(start), int(end))
        for start, end, state in zip(guard["stamp_ns"], ends, guard["state"], strict=True)
        if state == GuardState.HOLD
    ]
