# SPDX-License-Identifier: Apache-2.0

"""Metrics of cloud's perception: how old what the robot saw is when the robot acts on it."""

from __future__ import annotations

import numpy as np

from cloudrc.metrics.definitions import age
from cloudrc.metrics.flight import Array, Flight, add_measures
from cloudrc.record.columns import datagrams
from cloudrc.records import UNSENT


def acted(flight: Flight) -> tuple[Array, Array]:
    """Return for each scan on which the robot acted in a flight its stamp, and when it acted [ns].

    That is when world applied the first command from the setpoint that the perception made of the
    scan. A setpoint whose commands are all lost, or that the next one replaced before, has none.
    """
    seen, applied = flight.during("/perception"), flight.during("/command_applied")
    steers = seen["counter"] != UNSENT
    first = datagrams({name: seen[name][steers] for name in ("epoch", "counter")})
    numbers = datagrams(applied)
    order = np.argsort(numbers, kind="stable")
    at = np.searchsorted(numbers, first, sorter=order)
    # The setpoint of the next scan begins with `ends`.
    ends = np.append(first[1:], np.iinfo(np.int64).max)
    known = at < len(numbers)
    rows = order[at[known]]
    same = (numbers[rows] < ends[known]) & (numbers[rows] >> 32 == first[known] >> 32)
    stamps_ns: Array = seen["seen_stamp_ns"][steers][known][same]
    return stamps_ns, applied["stamp_ns"][rows[same]]


def _seen_to_acted(flight: Flight) -> Array:
    stamps_ns, applied_ns = acted(flight)
    ages: Array = age(applied_ns, stamps_ns)
    return ages


def _dropped(flight: Flight) -> float | None:
    return flight.growth("seen_dropped") if len(flight.recording["/perception"]) else None


add_measures(
    ("seen_to_acted", _seen_to_acted, "mean"),
    ("seen_to_acted_p99", _seen_to_acted, "p99"),
    ("seen_dropped", _dropped),
)
