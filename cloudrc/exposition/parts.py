"""Compute parts of the live metrics: histograms, lost datagrams, errors of predictions.

The thread of the control loop stores and counts records, in 1 to 2 us per record. The thread that
serves the metrics does all other work.
"""

from __future__ import annotations

from bisect import bisect_left
from heapq import heappop, heappush
from itertools import accumulate
from math import isnan, nan
from typing import Any, TypeAlias

from cloudrc.exposition.table import AXES, Labels
from cloudrc.messages import NEVER_NS, Vector
from cloudrc.records import Control


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


WINDOW = 128
"""A missing datagram counts as lost after this number of newer datagrams (1.28 s at 100 Hz)."""
_MASK = (1 << WINDOW) - 1


class DatagramTally:
    """Counts lost and reordered datagrams of one direction of the link.

    The sender numbers datagrams by a counter, which restarts in each epoch (session).
    """

    __slots__ = ("_before", "_epoch", "_first", "_newest", "_seen", "lost", "reordered")

    def __init__(self) -> None:
        self.lost = 0  # datagrams that had not arrived when the peer had sent `WINDOW` newer ones
        self.reordered = 0  # datagrams that arrived after a newer one, without repetitions
        self._before = 0  # value of `expected` at the end of the last epoch
        self._epoch = self._first = self._newest = -1
        self._seen = _MASK  # bit k: the datagram with the counter newest - k has arrived

    @property
    def expected(self) -> int:
        """Number of datagrams for which the receiver no longer waits: arrived or lost."""
        return self._before + max(0, self._newest - self._first - WINDOW + 1)

    def take(self, epoch: int, counter: int) -> bool:
        """Count the arrival of a datagram; return True if the datagram is certainly new.

        Return False for a repeated or very old datagram: an attacker may have sent it again.
        """
        if epoch != self._epoch:
            # Datagrams before the first arrival are not lost: the receiver may not have run.
            self._before = self.expected
            self._epoch, self._first, self._newest, self._seen = epoch, counter, counter, _MASK
            return True
        ahead = counter - self._newest
        if ahead > 0:  # the skipped datagrams are lost or late
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
"""Longest time between two measurements over which positions are interpolated [ns]."""
WAITING_MAX = 256
"""Largest number of stored predictions or commands; 100 are enough for delays of 1 s."""


class PredictionJudge:
    """Compares each predicted position with the position measured at the same instant."""

    def __init__(self) -> None:
        self.error: Vector = (nan, nan, nan)  # newest error: predicted minus measured position [m]
        self.square = 0.0  # sum of the squared lengths of all errors [m^2]
        self.judged = 0  # number of compared predictions
        self.reset()

    def reset(self) -> None:
        """Drop all predictions and measurements, because a new session has started."""
        self._waiting: list[tuple[int, Vector]] = []
        self._measured_ns = NEVER_NS
        self._measured: Vector = (nan, nan, nan)

    def take(self, control: Control) -> None:
        """Judge predictions for times up to a new measurement; store the new prediction."""
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
    """Compares delay estimates with true delays.

    Cloud computes each command from an odometry sample. The delay is the time from the stamp of
    this sample until world applies the command. Telemetry contains an echo of the newest command
    that world has applied: the command's stamp on cloud's clock, and the time since then.
    """

    def __init__(self) -> None:
        self.error = nan  # newest error: estimated minus true delay [s]
        self.reset()

    def reset(self) -> None:
        """Drop the records of commands without an echo, because a new session has started."""
        self._sent: dict[int, Control] = {}

    def sent(self, control: Control) -> None:
        """Store the record of a sent command; its echo will show the true delay."""
        self._sent[control.stamp_ns] = control
        if len(self._sent) > WAITING_MAX:
            del self._sent[next(iter(self._sent))]  # the oldest

    def echoed(self, control: Control, arrival_ns: int) -> None:
        """Compute how wrong the estimated delay was for a command whose echo has arrived.

        The echo arrived at `arrival_ns` [ns], cloud's clock. `control` is the record of the first
        control period after this arrival; it contains the delays that the echo shows.
        """
        sent = self._sent.get(arrival_ns - round(control.loop_delay * 1e9))
        if sent is not None:
            applied_ns = control.basis_stamp_ns - round((control.loop_delay - control.rtt) * 1e9)
            self.error = sent.horizon - (applied_ns - sent.basis_stamp_ns) * 1e-9
