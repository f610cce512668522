"""How late a relay is: the lateness of each datagram goes in, percentiles and counts come out.

Memory is bounded and a datagram costs a tenth of a microsecond: errors are counted in three rows of
buckets, of 1 us up to 1 ms, of 66 us up to 67 ms, and of 67 ms beyond. Only those that were met are
kept, some hundred, so that to ask once a second costs little.

How early a relay wakes: how late it woke before goes in, how much earlier to wake comes out.

A thread that sleeps until an instant wakes 15 to 50 us after it. So the relay sleeps until a little
before and looks at the clock until it is time. How long that takes is bounded, each time and as a
share of all time: no core is burnt that world or cloud need.
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


LEAD_MAX_NS, FIRST_LEAD_MAX_NS = 60_000, 150_000
"""Longest look at the clock, each time [ns]: of an ordinary thread, and of one under SCHED_FIFO.

Later wakes have other causes than the timer: other programs, or other virtual machines.
"""
SHARE_MAX, FIRST_SHARE_MAX = 0.05, 0.10
"""Largest share of a core that goes into looking at the clock, in [0, 1], of either."""

_LEAD_MIN_NS = 5_000
_LEAD_FIRST_NS = 40_000
_RISE_NS, _FALL_NS = 990, 10
_CREDIT_MAX_NS = 10_000_000


class Lead:
    """Follows the 99th percentile of how late the thread wakes.

    Deviation from a sorted window: each wake moves the lead up by 990 ns or down by 10 ns, which
    stays where 1 in 100 wakes is later, costs nothing and follows the machine's load.
    """

    __slots__ = ("_credit_ns", "_most_ns", "_now_ns", "_share", "_wanted_ns")

    def __init__(self, *, first: bool = False) -> None:
        """Begin with what most machines need.

        Args:
            first: Whether the thread runs before every ordinary one.
        """
        self._most_ns = FIRST_LEAD_MAX_NS if first else LEAD_MAX_NS
        self._share = FIRST_SHARE_MAX if first else SHARE_MAX
        self._wanted_ns = _LEAD_FIRST_NS
        self._credit_ns = _CREDIT_MAX_NS
        self._now_ns = 0

    def ahead_ns(self) -> int:
        """Say how long before it is due to wake [ns]; 0 while the share is used up."""
        return self._wanted_ns if self._credit_ns > 0 else 0

    def woke(self, late_ns: int) -> None:
        """Learn how late the thread woke [ns], after the instant that it asked for."""
        if late_ns > self._wanted_ns:
            self._wanted_ns = min(self._wanted_ns + _RISE_NS, self._most_ns)
        else:
            self._wanted_ns = max(self._wanted_ns - _FALL_NS, _LEAD_MIN_NS)

    def looked(self, since_ns: int, until_ns: int) -> None:
        """Learn that it has looked at the clock from one instant [ns] to another."""
        earned_ns = round(self._share * (until_ns - self._now_ns))
        self._now_ns = until_ns
        credit_ns = self._credit_ns + earned_ns - (until_ns - since_ns)
        self._credit_ns = min(credit_ns, _CREDIT_MAX_NS)

    def rests(self, now_ns: int) -> None:
        """Learn at an instant [ns] that it has not looked: time alone earns credit again."""
        if self._credit_ns <= 0:
            self.looked(now_ns, now_ns)
