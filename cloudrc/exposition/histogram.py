"""A histogram that costs little: one search and two additions per value."""

from __future__ import annotations

from bisect import bisect_left


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
