# SPDX-License-Identifier: Apache-2.0

"""Age of information over time, exactly: it rises, and a fresher update lowers it.

Source: S. Kaul, R. Yates, M. Gruteser, "Real-time status: how often should one update?", IEEE
INFOCOM 2012. The mean peak age: M. Costa, M. Codreanu, A. Ephremides, "On the age of information in
status update systems with packet management", IEEE Transactions on Information Theory 62 (4), 2016.
"""

from __future__ import annotations

from typing import Any, NamedTuple, TypeAlias

import numpy as np
from numpy.typing import NDArray

from cloudrc.results.metrics.definitions import age

Array: TypeAlias = NDArray[Any]
WINDOW = 10
"""Number of successive steps among which the missed ones are counted."""


class Ages(NamedTuple):
    """The pieces of time in which the age rises, in their order, each of shape (n,)."""

    begin_ns: Array  # when a piece begins [ns]
    low: Array  # age at its beginning [s]
    high: Array  # age at its end [s]
    is_peak: Array  # whether a fresher update ends it [1]


def sawtooth(edges_ns: Array, arrived_ns: Array, basis_ns: Array) -> Ages:
    """Compute the age of what a receiver uses, between two edges each.

    The receiver uses each update until the next arrives. One that another has overtaken raises the
    age, and no peak ends with it.

    Args:
        edges_ns: Instants [ns], rising, shape (n + 1,): at least all arrivals from the first on.
        arrived_ns: Arrivals of the updates [ns], rising, shape (m,).
        basis_ns: Stamps of the data in them, on the same clock [ns], shape (m,).
    """
    used = arrived_ns.searchsorted(edges_ns, "right") - 1
    freshest = np.maximum.accumulate(basis_ns)[used]
    begin_ns, basis_ns = edges_ns[:-1], basis_ns[used[:-1]]
    return Ages(
        begin_ns, age(begin_ns, basis_ns), age(edges_ns[1:], basis_ns), np.diff(freshest) > 0
    )


def tail(ages: Ages) -> tuple[Array, Array]:
    """Return ages [s], rising, and the share of the time in which the age is above each [1].

    Between two of them, the share is linear.
    """
    ends = np.concatenate([ages.low, ages.high])
    order = ends.argsort(kind="stable")
    # So many pieces have ages between an end and the next one.
    pieces = np.repeat([1, -1], len(ages.low))[order].cumsum()
    found = ends[order]
    below = np.append(0.0, np.cumsum(pieces[:-1] * np.diff(found)))
    return found, 1.0 - below / below[-1]


def describe(ages: Ages, limit: float | None = None) -> dict[str, float]:
    """Return mean, p99, max and peak_mean [s] of the age, averaged over time.

    With a `limit` [s], also return the share of the time in which the age is above: violation.
    What is unknown is left out.
    """
    if not len(ages.low):
        return {}
    found, above = tail(ages)
    numbers = {
        "mean": float(np.average((ages.low + ages.high) / 2.0, weights=ages.high - ages.low)),
        "p99": float(np.interp(0.99, 1.0 - above, found)),
        "max": float(found[-1]),
    }
    if ages.is_peak.any():
        numbers["peak_mean"] = float(ages.high[ages.is_peak].mean())
    if limit is not None:
        numbers["violation"] = float(np.interp(limit, found, above))
    return numbers


def most_missed(missed: Array) -> int:
    """Return the largest number of missed steps among `WINDOW` successive ones.

    `missed` [1] tells it of each step, shape (n,).
    Source: G. Bernat, A. Burns, A. Llamosi, "Weakly hard real-time systems", IEEE Transactions on
    Computers 50 (4), 2001: m misses in any K.
    """
    return int(np.convolve(missed, np.ones(WINDOW)).max()) if len(missed) else 0
