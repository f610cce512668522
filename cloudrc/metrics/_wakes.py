"""Wakes of the two ends, which exist in real time only: a recording of virtual time has none."""

from __future__ import annotations

from cloudrc.metrics._flight import Array, Flight


def wakes(flight: Flight, end: str) -> dict[str, Array]:
    """Take the rows of /lateness that one end recorded during the flight.

    Args:
        flight: Of any mode.
        end: "world" or "cloud".
    """
    columns = flight.during("/lateness")
    rows = columns["end"] == end
    return {name: column[rows] for name, column in columns.items()}


def slip(flight: Flight) -> float | None:
    """By how much world's clock fell behind its machine's during the flight [s]."""
    slips = wakes(flight, "world")["slip_ns"]
    return float(slips[-1] - slips[0]) * 1e-9 if len(slips) else None
