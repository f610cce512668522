# SPDX-License-Identifier: Apache-2.0

"""Metrics of cloud's perception: how old what the robot saw is when the robot acts on it."""

from __future__ import annotations

import numpy as np

from cloudrc.results.metrics.definitions import age
from cloudrc.results.metrics.flight import Array, Columns, Flight, add_measures, select
from cloudrc.results.record.columns import datagrams
from cloudrc.wire.records import UNSENT


def acted(flight: Flight) -> tuple[Columns, Columns]:
    """Find the scans on which the robot acted in a flight.

    A setpoint whose commands are all lost, or that the next one replaced before, has no command.

    Returns:
        Their rows of /perception; and for each of them the row of /command_applied of the first
        command that world applied from the setpoint which the perception made of the scan.
    """
    seen, applied = flight.during("/perception"), flight.during("/command_applied")
    seen = select(seen, seen["counter"] != UNSENT)
    first = datagrams(seen)
    numbers = datagrams(applied)
    order = np.argsort(numbers, kind="stable")
    at = np.searchsorted(numbers, first, sorter=order)
    # The setpoint of the next scan begins with `ends`.
    ends = np.append(first[1:], np.iinfo(np.int64).max)
    known = at < len(numbers)
    rows = order[at[known]]
    same = (numbers[rows] < ends[known]) & (numbers[rows] >> 32 == first[known] >> 32)
    return select(seen, np.flatnonzero(known)[same]), select(applied, rows[same])


def _seen_to_acted(flight: Flight) -> Array:
    seen, applied = acted(flight)
    ages: Array = age(applied["stamp_ns"], seen["seen_stamp_ns"])
    return ages


def _dropped(flight: Flight) -> float | None:
    return flight.growth("seen_dropped") if len(flight.recording["/perception"]) else None


add_measures(
    ("seen_to_acted", _seen_to_acted, "mean"),
    ("seen_to_acted_p99", _seen_to_acted, "p99"),
    ("seen_to_acted_max", _seen_to_acted, "max"),
    ("seen_dropped", _dropped),
)
