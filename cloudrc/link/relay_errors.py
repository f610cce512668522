"""How late a relay is: the lateness of each datagram goes in, percentiles and counts come out.

Memory is bounded and a datagram costs a tenth of a microsecond: errors are counted in three rows of
buckets, of 1 us up to 1 ms, of 66 us up to 67 ms, and of 67 ms beyond.
"""

from __future__ import annotations

from bisect import bisect_left
from collections import deque
from collections.abc import Iterable
from itertools import accumulate
from operator import add, sub

_ROW = 1024
_WIDTH_BITS = (10, 16, 26)
_LIMITS = tuple(_ROW << bits for bits in _WIDTH_BITS)

_RECENT = 10
QUANTILES = {"p50": 0.5, "p99": 0.99, "p999": 0.999}


class ReleaseErrors:
    """Counts how long after they were due datagrams left, since the beginning.

    Attributes:
        early: How many left before they were due: none, unless this code is wrong.
        total_ns: Sum of all errors [ns].
    """

    __slots__ = ("_rows", "early", "total_ns")

    def __init__(self) -> None:
        """Begin empty."""
        self.early = self.total_ns = 0
        self._rows = [[0] * _ROW for _ in _WIDTH_BITS]

    def observe(self, error_ns: int) -> None:
        """Count one datagram that left `error_ns` [ns] after it was due."""
        self.total_ns += error_ns
        if error_ns < _LIMITS[0]:
            if error_ns < 0:
                self.early += 1
                error_ns = 0
            self._rows[0][error_ns >> 10] += 1
        elif error_ns < _LIMITS[1]:
            self._rows[1][error_ns >> 16] += 1
        else:
            self._rows[2][min(error_ns >> 26, _ROW - 1)] += 1

    @classmethod
    def together(cls, parts: Iterable[ReleaseErrors]) -> ReleaseErrors:
        """Add up what several have counted."""
        whole = cls()
        for part in parts:
            whole.early += part.early
            whole.total_ns += part.total_ns
            for row, other in zip(whole._rows, part._rows, strict=True):
                row[:] = map(add, row, other)
        return whole

    def quantiles(self) -> dict[str, float]:
        """Say how late the datagrams left.

        Returns:
            `release_error_p50`, `_p99` and `_p999` [s], each at most one bucket too large; empty
            before the first datagram.
        """
        below = list(accumulate(count for row in self._rows for count in row))
        if not below[-1]:
            return {}
        return {
            f"release_error_{name}": _upper(_rank(below, share)) * 1e-9
            for name, share in QUANTILES.items()
        }

    def since(self, before: ReleaseErrors) -> ReleaseErrors:
        """Leave out what had been counted earlier."""
        rest = ReleaseErrors()
        rest.early = self.early - before.early
        rest.total_ns = self.total_ns - before.total_ns
        for row, own, other in zip(rest._rows, self._rows, before._rows, strict=True):
            row[:] = map(sub, own, other)
        return rest


class Recent:
    """How late a relay was of late, if it is asked once a second."""

    def __init__(self) -> None:
        """Begin before the first datagram."""
        self._past: deque[ReleaseErrors] = deque([ReleaseErrors()], maxlen=_RECENT)

    def counts(self, errors: ReleaseErrors) -> dict[str, int]:
        """Say it in whole nanoseconds, beside the datagrams that left early since the beginning.

        Args:
            errors: Since the beginning.

        Returns:
            `released_early`; and `release_error_p50_ns`, `_p99_ns` and `_p999_ns` over the last
            ten calls [ns], absent if nothing left since.
        """
        quantiles = errors.since(self._past[0]).quantiles()
        self._past.append(errors)
        counts = {f"{name}_ns": round(late * 1e9) for name, late in quantiles.items()}
        return {"released_early": errors.early, **counts}


def _rank(below: list[int], share: float) -> int:
    """Find the bucket in which the share of all is reached."""
    return bisect_left(below, max(1, -int(-share * below[-1] // 1)))


def _upper(bucket: int) -> int:
    """Say where a bucket ends [ns]."""
    row, place = divmod(bucket, _ROW)
    return (place + 1) << _WIDTH_BITS[row]
