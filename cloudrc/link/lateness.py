"""Count how late a relay releases datagrams, and return percentiles of the lateness.

The counts are a histogram. Its buckets are at most 1.6 % wide, so that memory is bounded; counting
one datagram takes far less than a microsecond.
"""

from __future__ import annotations

from collections import Counter, deque
from collections.abc import Iterable

QUANTILES = {"p50": 0.5, "p99": 0.99, "p999": 0.999}
_BITS = 7
"""How many significant bits of a lateness select the bucket [1]."""
_RECENT = 10
"""Number of calls of `Recent.counts` that the percentiles cover [1]."""


class ReleaseErrors:
    """Histogram of the lateness: the time from when a datagram was due until it left.

    Attributes:
        early: Number of datagrams that left before they were due; above 0 is a fault.
    """

    __slots__ = ("_counts", "early")

    def __init__(self) -> None:
        """Start empty."""
        self.early = 0
        self._counts: dict[int, int] = {}

    def observe(self, error_ns: int) -> None:
        """Count one datagram that left `error_ns` [ns] after it was due."""
        if error_ns < 0:
            self.early += 1
            error_ns = 0
        shift = max(0, error_ns.bit_length() - _BITS)
        bucket = (shift << _BITS) + (error_ns >> shift)
        self._counts[bucket] = self._counts.get(bucket, 0) + 1

    @property
    def count(self) -> int:
        """Return the number of datagrams that have left."""
        return sum(dict(self._counts).values())

    @classmethod
    def together(cls, parts: Iterable[ReleaseErrors]) -> ReleaseErrors:
        """Add up the counts of several directions."""
        whole, counts = cls(), Counter[int]()
        for part in parts:
            whole.early += part.early
            counts.update(dict(part._counts))  # a copy: another thread may be counting
        whole._counts = dict(counts)
        return whole

    def since(self, before: ReleaseErrors) -> ReleaseErrors:
        """Return the counts since an earlier copy: these counts minus `before`."""
        rest = ReleaseErrors()
        rest.early = self.early - before.early
        rest._counts = dict(Counter(self._counts) - Counter(before._counts))
        return rest

    def quantiles(self) -> dict[str, float]:
        """Return `release_error_p50`, `_p99` and `_p999` [s]; empty before the first datagram."""
        counts, below = sorted(dict(self._counts).items()), 0
        wanted = [(f"release_error_{name}", share) for name, share in QUANTILES.items()]
        whole, found = sum(count for _, count in counts), dict[str, float]()
        for bucket, count in counts:
            below += count
            shift, start = divmod(bucket, 1 << _BITS)
            while wanted and below >= wanted[0][1] * whole:
                found[wanted.pop(0)[0]] = ((start + 1) << shift) * 1e-9
        return found


def in_ns(errors: ReleaseErrors) -> dict[str, int]:
    """Return the lateness since the beginning in whole nanoseconds.

    Returns:
        `released`, `released_early`, and `release_error_p50_ns`, `_p99_ns` and `_p999_ns` [ns];
        empty before the first datagram.
    """
    quantiles = {f"{name}_ns": round(late * 1e9) for name, late in errors.quantiles().items()}
    if not quantiles:
        return {}
    return {"released": errors.count, "released_early": errors.early, **quantiles}


class Recent:
    """Percentiles over the last ten calls of `counts`: ten seconds if called once a second."""

    def __init__(self) -> None:
        """Start before the first datagram."""
        self._past: deque[ReleaseErrors] = deque([ReleaseErrors()], maxlen=_RECENT)

    def counts(self, errors: ReleaseErrors) -> dict[str, int]:
        """Return the recent percentiles in whole nanoseconds.

        Args:
            errors: Counts since the beginning, as a copy that no thread changes any more.

        Returns:
            `released_early` since the beginning; `release_error_p50_ns`, `_p99_ns` and `_p999_ns`
            over the last ten calls [ns]. The percentiles are absent if no datagram left in that
            time.
        """
        recent = in_ns(errors.since(self._past[0]))
        self._past.append(errors)
        recent.pop("released", None)
        return {**recent, "released_early": errors.early}
