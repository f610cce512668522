"""How many records the recorder had to drop so that the loop did not have to wait."""

from __future__ import annotations

from cloudrc.metrics import Flight

UNIT = "1"


def measure(flight: Flight) -> float | None:
    """Sum over both ends of the last count [1]; None where it was not counted."""
    count = flight.recording["/count"]
    last = {
        str(end): int(value)
        for end, name, value in zip(count["end"], count["name"], count["total"], strict=True)
        if name == "recorder_dropped"
    }
    return float(sum(last.values())) if last else None
