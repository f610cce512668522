"""How late a relay is: the lateness of each datagram goes in, percentiles and counts come out.

Memory is bounded and a datagram costs a tenth of a microsecond: errors are counted in three rows of
buckets, of 1 us up to 1 ms, of 66 us up to 67 ms, and of 67 ms beyond. Only those that were met are
kept, some hundred, so that to ask once a second costs little.
"""

from __future__ import annotations

from collections import Counter, deque
from collections.abc import Iterable

_ROW = 1024
_WIDTH_BITS = (10, 16, 26)
_LIMITS = tuple(_ROW << bits for bits in _WIDTH_BITS)

_RECENT = 10
QUANTILES = {"p50": 0.5, "p99": 0.99, "p999": 0.999}


class ReleaseErrors:
    """Counts how long after they were due datagrams left, since the beginning.

    Attributes:
        early: How many left before they were due: none, unless this code is wrong.
    """

    __slots__ = ("_met", "early")

    def __init__(self) -> None:
        """Begin empty."""
        self.early = 0
        self._met: dict[int, int] = {}

    def observe(self, error_ns: int) -> None:
        """Count one datagram that left `error_ns` [ns] after it was due."""
        if error_ns < _LIMITS[0]:
            if error_ns < 0:
                self.early += 1
                error_ns = 0
            bucket = error_ns >> 10
        elif error_ns < _LIMITS[1]:
            bucket = _ROW + (error_ns >> 16)
        else:
            bucket = 2 * _ROW + min(error_ns >> 26, _ROW - 1)
        self._met[bucket] = self._met.get(bucket, 0) + 1

    @property
    def count(self) -> int:
        """How many datagrams have left."""
        return sum(dict(self._met).values())

    @classmethod
    def together(cls, parts: Iterable[ReleaseErrors]) -> ReleaseErrors:
        """Add up what several have counted."""
        whole, met = cls(), Counter[int]()
        for part in parts:
            whole.early += part.early
            met.update(part._met)
        whole._met = dict(met)
        return whole

    def quantiles(self) -> dict[str, float]:
        """Say how late the datagrams left.

        Returns:
            `release_error_p50`, `_p99` and `_p999` [s], each at most one bucket too large; empty
            before the first datagram.
        """
        met = sorted(dict(self._met).items())  # copied at once: another thread may go on
        if not met:
            return {}
        whole, below, found = sum(count for _, count in met), 0, dict[str, float]()
        wanted = [(f"release_error_{name}", share * whole) for name, share in QUANTILES.items()]
        for bucket, count in met:
            below += count
            while wanted and below >= wanted[0][1]:
                found[wanted.pop(0)[0]] = _upper(bucket) * 1e-9
        return found

    def since(self, before: ReleaseErrors) -> ReleaseErrors:
        """Leave out what had been counted earlier."""
        rest, earlier = ReleaseErrors(), before._met.get
        rest.early = self.early - before.early
        rest._met = {
            bucket: count - earlier(bucket, 0)
            for bucket, count in self._met.items()
            if count != earlier(bucket, 0)
        }
        return rest


def in_ns(errors: ReleaseErrors) -> dict[str, int]:
    """Say in whole nanoseconds how late datagrams left, since the beginning.

    Returns:
        `released`, `released_early`, and `release_error_p50_ns`, `_p99_ns` and `_p999_ns` [ns];
        empty before the first datagram.
    """
    quantiles = {f"{name}_ns": round(late * 1e9) for name, late in errors.quantiles().items()}
    if not quantiles:
        return {}
    return {"released": errors.count, "released_early": errors.early, **quantiles}


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


def _upper(bucket: int) -> int:
    """Say where a bucket ends [ns]."""
    row, place = divmod(bucket, _ROW)
    return (place + 1) << _WIDTH_BITS[row]
