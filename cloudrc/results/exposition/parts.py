# SPDX-License-Identifier: Apache-2.0

"""Store the values of live metrics: histograms, and numbers by the values of their labels.

The thread of the control loop stores and counts records, in 1 to 2 us per record. The thread that
serves the metrics does all other work.
"""

from __future__ import annotations

from bisect import bisect_left
from itertools import accumulate
from math import isnan
from typing import Any, TypeAlias

from cloudrc.results.exposition.table import AXES, Labels


class Histogram:
    """Counts values in buckets. One thread calls `observe`, any other thread may read."""

    __slots__ = ("_counts", "bounds", "total")

    def __init__(self, bounds: tuple[float, ...]) -> None:
        """Set the upper bounds of the buckets, inclusive, in rising order."""
        self.bounds = bounds
        self.total = 0.0  # sum of all observed values
        self._counts = [0] * (len(bounds) + 1)

    def __bool__(self) -> bool:
        """Return whether any value was observed."""
        return any(self._counts)

    def observe(self, value: float) -> None:
        """Add `value` [unit of the bounds] to the count of its bucket and to the total."""
        self._counts[bisect_left(self.bounds, value)] += 1
        self.total += value

    def cumulative(self) -> list[int]:
        """Return the number of values up to each bound and, as last entry, of all values."""
        return list(accumulate(list(self._counts)))  # copy: another thread counts


Readings: TypeAlias = dict[str, "dict[Labels, float] | Histogram"]
"""Name of a metric -> its values by tuple of label values, or a histogram, which has no labels."""


def samples(value: Any, labels: Labels = ()) -> dict[Labels, float]:
    """Return the numbers in the value of a metric by tuple of label values; leave out NaN.

    `value` is a number, a vector with the label `axis`, or a dict: value of a label -> number,
    vector or dict. `labels` are the label values that are already known.
    """
    if isinstance(value, tuple):
        value = dict(zip(AXES, value, strict=True))
    if not isinstance(value, dict):
        return {} if isnan(value) else {labels: value}
    parts = (samples(each, (*labels, label)) for label, each in value.items())
    return {key: number for part in parts for key, number in part.items()}
