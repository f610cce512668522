"""What the parts of a process's metrics have in common: handlers of records, readings for a scrape.

A handler runs on the loop's thread and has one microsecond: it keeps the newest record, counts, and
leaves everything else to `read`, which runs on the thread that is scraped.

A histogram that costs little: one search and two additions per value.

What arrives in one direction: counters come in; expected, lost and reordered are counted.
"""

from __future__ import annotations

from bisect import bisect_left
from collections.abc import Callable, Iterable, Mapping
from math import isnan
from typing import Any, Protocol, TypeAlias

from cloudrc.exposition.table import AXES, Labels
from cloudrc.messages import Vector


class Histogram:
    """Counts values by buckets; one thread observes, any other may read.

    Attributes:
        bounds: Upper bounds of the buckets, each included, rising.
        total: Sum of all values.
    """

    __slots__ = ("_counts", "bounds", "total")

    def __init__(self, bounds: tuple[float, ...]) -> None:
        """Begin empty."""
        self.bounds = bounds
        self.total = 0.0
        self._counts = [0] * (len(bounds) + 1)

    def observe(self, value: float) -> None:
        """Count a `value` [unit of the bounds]."""
        self._counts[bisect_left(self.bounds, value)] += 1
        self.total += value

    def cumulative(self) -> list[int]:
        """How many values are at most each bound; the last is how many there are in all."""
        counts, below = list(self._counts), 0  # copied at once: the other thread may go on
        for index, count in enumerate(counts):
            below += count
            counts[index] = below
        return counts


Handlers: TypeAlias = Mapping[type, Callable[[Any], None]]
Readings: TypeAlias = dict[str, "dict[Labels, float] | Histogram"]
"""By metric: a value for each tuple of label values, or a histogram, which has no labels."""


class Part(Protocol):
    """Some of the metrics of one process."""

    def handlers(self) -> Handlers:
        """Which records it wants to see; no two parts of a process want the same."""

    def read(self) -> Readings:
        """Say all that is known now; what is not known is absent."""


def plain(value: float) -> dict[Labels, float]:
    """A metric without labels, of one `value` [base unit of the metric]."""
    return {(): value}


def known(value: float) -> dict[Labels, float]:
    """The same; absent if `value` [base unit of the metric] is NaN."""
    return {} if isnan(value) else {(): value}


def per_axis(vector: Vector) -> dict[Labels, float]:
    """A metric with the label axis; absent where `vector` [base unit of the metric] is NaN."""
    values = zip(AXES, vector, strict=True)
    return {(axis,): value for axis, value in values if not isnan(value)}


def by(counts: Mapping[str, float]) -> dict[Labels, float]:
    """A metric with one label."""
    return {(name,): count for name, count in counts.items()}


def chosen(names: Iterable[str], counts: Mapping[str, float]) -> dict[str, float]:
    """The counts of these names, 0 where nothing was counted."""
    return {name: counts.get(name, 0) for name in names}


WINDOW = 128
"""So many datagrams later one that has not arrived is lost: 1.28 s at 100 Hz."""
_MASK = (1 << WINDOW) - 1
_OLDEST = 1 << (WINDOW - 1)


class Stream:
    """The counters of one direction, epoch by epoch.

    Attributes:
        lost: Datagrams that had not arrived when they left the window.
        reordered: Datagrams that arrived after a newer one; repeated ones are none.
    """

    __slots__ = ("_before", "_epoch", "_first", "_newest", "_seen", "lost", "reordered")

    def __init__(self) -> None:
        """Begin before the first datagram."""
        self.lost = self.reordered = 0
        self._before = 0  # expected in earlier epochs
        self._epoch = self._first = self._newest = -1
        self._seen = _MASK  # bit k: newest - k has arrived

    @property
    def expected(self) -> int:
        """How many datagrams have left the window: those that are judged, arrived or lost."""
        return self._before + max(0, self._newest - self._first - WINDOW + 1)

    def take(self, epoch: int, counter: int) -> bool:
        """Note that the datagram with this counter has arrived; True if it is sure to be new.

        Any other may be one that was caught and sent again, which takes no key.
        """
        if epoch != self._epoch:
            # What was sent before the first arrival may have been sent to nobody: not judged.
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
        """Move the window; those between never arrive, or late."""
        leaving = min(ahead, WINDOW)
        self.lost += leaving - (self._seen >> (WINDOW - leaving)).bit_count()
        self.lost += ahead - leaving
        self._seen = (self._seen << ahead | 1) & _MASK if ahead < WINDOW else 1
