"""What a relay tells of itself: counts go in, how late it released the datagrams comes out."""

from __future__ import annotations

from cloudrc.metrics._flight import Flight


def told(flight: Flight, name: str, scale: float = 1.0) -> float | None:
    """Give the last that was told, since the relay began; None where no relay shaped.

    Args:
        flight: A recorded flight.
        name: Of the count, "uplink_released" for example.
        scale: From what is counted to the unit asked for [1].
    """
    count = flight.recording["/count"]
    rows = zip(count["name"], count["total"], strict=True)
    totals = [int(total) for one, total in rows if one == name]
    return totals[-1] * scale if totals else None
