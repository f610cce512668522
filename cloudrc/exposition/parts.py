"""Compute parts of the live metrics: histograms, lost datagrams, errors of predictions.

A handler of records runs on the loop's thread and has a budget of 1 us. Therefore a handler only
stores the newest record and counts. `read` does all other work, on the thread that serves the
scrape.
"""

from __future__ import annotations

from bisect import bisect_left
from collections.abc import Mapping
from heapq import heappop, heappush
from itertools import accumulate
from math import isnan, nan
from typing import TypeAlias

from cloudrc.exposition.table import AXES, Labels
from cloudrc.messages import NEVER_NS, Vector
from cloudrc.records import Control


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
        return list(accumulate(list(self._counts)))  # one atomic copy: the loop may count on


Readings: TypeAlias = dict[str, "dict[Labels, float] | Histogram"]
"""Metric name -> value for each tuple of label values, or a histogram (without labels)."""


def unlabelled(value: float) -> dict[Labels, float]:
    """Make a reading without labels from `value` [base unit of the metric]; absent if NaN."""
    return {} if isnan(value) else {(): value}


def per_axis(vector: Vector) -> dict[Labels, float]:
    """Make a reading per axis from `vector` [base unit of the metric]; NaN axes are absent."""
    values = zip(AXES, vector, strict=True)
    return {(axis,): value for axis, value in values if not isnan(value)}


def by_label(counts: Mapping[str, float]) -> dict[Labels, float]:
    """Make a reading with one label from a mapping of label values to values."""
    return {(name,): count for name, count in counts.items()}


WINDOW = 128
"""Number of newer datagrams after which a missing datagram counts as lost; 1.28 s at 100 Hz."""
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
        elif ahead > 1:  # the skipped datagrams are lost or late
            leaving = min(ahead, WINDOW)
            self.lost += ahead - (self._seen >> (WINDOW - leaving)).bit_count()
            self._seen = (self._seen << ahead | 1) & _MASK if ahead < WINDOW else 1
            self._newest = counter
        elif ahead > -WINDOW and not self._seen >> -ahead & 1:
            self._seen |= 1 << -ahead
            self.reordered += 1
        else:
            return False
        return True


GAP_MAX_NS = 50_000_000
"""Largest gap between two measurements over which positions are interpolated [ns]."""
WAITING_MAX = 256
"""Largest number of predictions that wait for a measurement; a horizon of 1 s needs 100."""


class PredictionJudge:
    """Compares each predicted position with the position measured at the same instant.

    Attributes:
        error: Newest error: predicted minus measured [m], shape (3,); NaN before the first.
        square: Sum of the squared lengths of all errors [m^2].
        judged: Number of compared predictions.
    """

    def __init__(self) -> None:
        """Create the judge; there is no prediction and no error yet."""
        self.error: Vector = (nan, nan, nan)
        self.square = 0.0
        self.judged = 0
        self.reset()

    def reset(self) -> None:
        """Drop predictions and measurements at the start of a new session."""
        self._waiting: list[tuple[int, Vector]] = []
        self._measured_ns = NEVER_NS
        self._measured: Vector = (nan, nan, nan)

    def take(self, control: Control) -> None:
        """Compare waiting predictions with a measurement; then store this period's prediction."""
        stamp_ns, waiting = control.basis_stamp_ns, self._waiting
        if stamp_ns > self._measured_ns:
            before_ns, before = self._measured_ns, self._measured
            self._measured_ns, self._measured = stamp_ns, control.measured
            while waiting and waiting[0][0] <= stamp_ns:
                at_ns, predicted = heappop(waiting)
                if before_ns <= at_ns and stamp_ns - before_ns <= GAP_MAX_NS:
                    share = (at_ns - before_ns) / (stamp_ns - before_ns)
                    self._judge(predicted, before, control.measured, share)
        if len(waiting) < WAITING_MAX:
            heappush(waiting, (stamp_ns + int(control.horizon * 1e9), control.position))

    def _judge(self, predicted: Vector, before: Vector, after: Vector, share: float) -> None:
        (px, py, pz), (ax, ay, az), (bx, by, bz) = predicted, before, after
        x = px - ax - share * (bx - ax)
        y = py - ay - share * (by - ay)
        z = pz - az - share * (bz - az)
        self.error = (x, y, z)
        self.square += x * x + y * y + z * z
        self.judged += 1


class DelayJudge:
    """Compares each delay estimate with the true time until the command was applied.

    World echoes the newest applied command in its telemetry. The stamp of this telemetry's odometry
    minus the hold time is the instant at which world applied the command, on world's clock. The
    echo also gives the command's age on cloud's clock, which identifies the command.

    Attributes:
        error: Newest error: estimate minus true time [s]; NaN before the first.
    """

    def __init__(self) -> None:
        """Create the judge; there is no command and no error yet."""
        self.error = nan
        self.reset()

    def reset(self) -> None:
        """Drop all commands at the start of a new session."""
        self._sent: dict[int, Control] = {}

    def sent(self, control: Control) -> None:
        """Store a command that cloud sent."""
        self._sent[control.stamp_ns] = control
        if len(self._sent) > WAITING_MAX:
            del self._sent[next(iter(self._sent))]  # the oldest

    def echoed(self, control: Control, arrival_ns: int) -> None:
        """Compute the error of the command whose echo arrived with this period's odometry.

        Args:
            control: First control period after the echo.
            arrival_ns: Arrival of the odometry with the echo [ns], cloud's clock.
        """
        sent = self._sent.get(arrival_ns - round(control.loop_delay * 1e9))
        if sent is not None:
            applied_ns = control.basis_stamp_ns - round((control.loop_delay - control.rtt) * 1e9)
            self.error = sent.horizon - (applied_ns - sent.basis_stamp_ns) * 1e-9
