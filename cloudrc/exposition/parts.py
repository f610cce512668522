"""Building blocks of live metrics: `Part`, a fast histogram, and loss counters of one direction.

A handler of records runs on the loop's thread and has a budget of 1 us. Therefore a handler only
stores the newest record and counts. `read` does all other work, on the thread that serves the
scrape.
"""

from __future__ import annotations

from bisect import bisect_left
from collections.abc import Callable, Iterable, Mapping
from math import isnan
from typing import Any, Protocol, TypeAlias

from cloudrc.exposition.table import AXES, Labels
from cloudrc.messages import Vector


class Histogram:
    """Counts values in buckets; one thread observes, any other thread may read.

    Attributes:
        bounds: Upper bounds of the buckets, inclusive, rising.
        total: Sum of all values.
    """

    __slots__ = ("_counts", "bounds", "total")

    def __init__(self, bounds: tuple[float, ...]) -> None:
        """Set the bounds; all counts are 0."""
        self.bounds = bounds
        self.total = 0.0
        self._counts = [0] * (len(bounds) + 1)

    def observe(self, value: float) -> None:
        """Count a `value` [unit of the bounds]."""
        self._counts[bisect_left(self.bounds, value)] += 1
        self.total += value

    def cumulative(self) -> list[int]:
        """Count the values up to each bound; the last entry counts all values."""
        counts, below = list(self._counts), 0  # one atomic copy: the loop's thread may count on
        for index, count in enumerate(counts):
            below += count
            counts[index] = below
        return counts


Handlers: TypeAlias = Mapping[type, Callable[[Any], None]]
Readings: TypeAlias = dict[str, "dict[Labels, float] | Histogram"]
"""Metric name -> value for each tuple of label values, or a histogram (without labels)."""


class Part(Protocol):
    """A group of metrics of one process."""

    def handlers(self) -> Handlers:
        """Map each class of records that this part uses to a handler; parts share no class."""

    def read(self) -> Readings:
        """Return the current values; unknown values are absent."""


def unlabelled(value: float) -> dict[Labels, float]:
    """Make a reading without labels from `value` [base unit of the metric]."""
    return {(): value}


def unless_nan(value: float) -> dict[Labels, float]:
    """Make a reading without labels from `value` [base unit of the metric]; absent if NaN."""
    return {} if isnan(value) else {(): value}


def per_axis(vector: Vector) -> dict[Labels, float]:
    """Make a reading per axis from `vector` [base unit of the metric]; NaN axes are absent."""
    values = zip(AXES, vector, strict=True)
    return {(axis,): value for axis, value in values if not isnan(value)}


def by_label(counts: Mapping[str, float]) -> dict[Labels, float]:
    """Make a reading with one label from a mapping of label values to values."""
    return {(name,): count for name, count in counts.items()}


def select(names: Iterable[str], counts: Mapping[str, float]) -> dict[str, float]:
    """Select counts by name; a missing count is 0."""
    return {name: counts.get(name, 0) for name in names}


WINDOW = 128
"""Number of newer datagrams after which a missing datagram counts as lost [1]; 1.28 s at 100 Hz."""
_MASK = (1 << WINDOW) - 1
_OLDEST = 1 << (WINDOW - 1)


class DatagramTally:
    """Counts lost and reordered datagrams of one direction by their counters, in each epoch.

    Attributes:
        lost: Datagrams that had not arrived when they left the window.
        reordered: Datagrams that arrived after a newer datagram, without repeated datagrams.
    """

    __slots__ = ("_before", "_epoch", "_first", "_newest", "_seen", "lost", "reordered")

    def __init__(self) -> None:
        """Set all counts to 0; no datagram has arrived yet."""
        self.lost = self.reordered = 0
        self._before = 0  # expected in earlier epochs
        self._epoch = self._first = self._newest = -1
        self._seen = _MASK  # bit k: newest - k has arrived

    @property
    def expected(self) -> int:
        """Number of datagrams that have left the window: each has arrived or counts as lost."""
        return self._before + max(0, self._newest - self._first - WINDOW + 1)

    def take(self, epoch: int, counter: int) -> bool:
        """Count the arrival of a datagram; return True if the datagram is certainly new.

        Any other datagram may be a replay: sending a captured datagram again needs no key.
        """
        if epoch != self._epoch:
            # Datagrams sent before the first arrival do not count: nobody may have listened yet.
            self._before = self.expected
            self._epoch, self._first, self._newest, self._seen = epoch, counter, counter, _MASK
            return True
        ahead = counter - self._newest
        if ahead == 1:
            if not self._seen & _OLDEST:
                self.lost += 1
            self._seen = (self._seen << 1 | 1) & _MASK
            self._newest = counter
        elif ahead > 1:
            self._skip(ahead)
            self._newest = counter
        elif ahead > -WINDOW and not self._seen >> -ahead & 1:
            self._seen |= 1 << -ahead
            self.reordered += 1
        else:
            return False
        return True

    def _skip(self, ahead: int) -> None:
        """Move the window by more than one datagram: the skipped datagrams are lost or late."""
        leaving = min(ahead, WINDOW)
        self.lost += leaving - (self._seen >> (WINDOW - leaving)).bit_count()
        self.lost += ahead - leaving
        self._seen = (self._seen << ahead | 1) & _MASK if ahead < WINDOW else 1
