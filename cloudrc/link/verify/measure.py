"""What the probes of one direction measured: instants of sending and arrival in, numbers out.

Sums over what arrives in flight: a few additions per datagram, added up where it is judged.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from math import nan

import numpy as np

from cloudrc.link.verify.reference import Flags, Floats, Frame, overtaken


@dataclass(slots=True)
class Log:
    """Probes of one direction as they were sent and arrived.

    Attributes:
        sent_ns: When each was sent [ns], by its number.
        arrivals: Number of the probe and when a copy of it arrived [ns], as they came; stamps of
            the clock that `sent_ns` is of.
    """

    sent_ns: list[int] = field(default_factory=list)
    arrivals: list[tuple[int, int]] = field(default_factory=list)


@dataclass(frozen=True, slots=True)
class Measured:
    """What a direction did to its probes.

    Attributes:
        sent: Probes.
        lost: Those of which no copy arrived.
        doubled: Those of which more than one did.
        mean: Of the delays of the first copies [s]; NaN if nothing arrived.
        deviation: Their standard deviation, about `over_time` if that was given [s].
        variation: Mean absolute difference of the delays of two sent in a row [s].
        reordered: Share of those that arrived that one sent later had overtaken, in [0, 1].
        middle: Standard deviation of the delays in the middle, as `Frame` has it [s]; NaN if
            there are none.
        damaged: Those of which a copy arrived, but not as it was sent.
        span: Mean time from a train's first arrival to its last [s]; NaN without trains.
        trains: How many trains that is the mean of.
    """

    sent: int
    lost: int
    doubled: int
    mean: float
    deviation: float
    variation: float
    reordered: float
    middle: float = nan
    damaged: int = 0
    span: float = nan
    trains: int = 0

    @property
    def arrived(self) -> int:
        """Probes of which at least one copy arrived."""
        return self.sent - self.lost


def measure(
    log: Log,
    over_time: Floats | None = None,
    spans: Sequence[float] = (),
    frame: Frame | None = None,
    damaged: int = 0,
) -> Measured:
    """Sum up a direction's log.

    Args:
        log: Of its probes.
        over_time: Delay expected of each [s], shape (n,), where that changes; else None.
        spans: How far trains were drawn out [s].
        frame: Of its probes; None: no middle is looked at.
        damaged: How many arrived, but not as they were sent.
    """
    count = len(log.sent_ns)
    origin_ns = log.sent_ns[0] if log.sent_ns else 0
    sent = np.array([stamp_ns - origin_ns for stamp_ns in log.sent_ns]) * 1e-9
    first, copies = np.full(count, np.inf), np.zeros(count, dtype=np.int64)
    if log.arrivals:
        numbers = np.array([number for number, _ in log.arrivals])
        instants = np.array([at_ns - origin_ns for _, at_ns in log.arrivals]) * 1e-9
        np.minimum.at(first, numbers, instants)
        np.add.at(copies, numbers, 1)
    lost = copies == 0
    delay = np.where(lost, np.nan, first - sent)
    there = delay[~lost]
    residual = there - (_mean(there) if over_time is None else over_time[:count][~lost])
    pairs = np.abs(np.diff(delay))
    return Measured(
        sent=count,
        lost=int(lost.sum()),
        doubled=int((copies > 1).sum()),
        mean=_mean(there),
        deviation=_mean(residual**2) ** 0.5,
        variation=_mean(pairs[np.isfinite(pairs)]),
        reordered=_mean(overtaken(first, lost)[~lost].astype(np.float64)),
        middle=_middle(frame, delay, ~lost),
        damaged=damaged,
        span=_mean(np.array(spans)),
        trains=len(spans),
    )


def _mean(values: Floats) -> float:
    return float(values.mean()) if len(values) else nan


def _middle(frame: Frame | None, delay: Floats, there: Flags) -> float:
    if frame is None:
        return nan
    inside, place = frame.look(np.where(there, delay, 0.0), there)
    return float(place[inside].std()) * frame.unit if inside.any() else nan


@dataclass(slots=True)
class Block:
    """Sums over the datagrams that arrived in some seconds.

    Attributes:
        sent: Datagrams by their counters that have arrived, or will not any more.
        lost: Of them, those that did not.
        arrived: Datagrams that arrived, copies left out.
        copies: Further copies.
        late: Arrived after a newer one.
        delays: Sum of delays [s].
        squares: Sum of their squares [s^2].
        steps: Sum of absolute differences of the delays of two in a row [s].
        pairs: How many those are.
        inside: How many of the delays were in the middle, as `Frame` has it.
        places: Sum of where in it, in units of jitter [1].
        place_squares: Sum of the squares of that [1].
        trips: Sum of round trips [s].
        trip_count: How many those are.
        timed: Of those that arrived, how many had a delay.
        lateness: Sum of what this end's wakes were late and busy [s].
        late_squares: Sum of the squares of that [s^2].
        late_cubes: Sum of the cubes of that [s^3].
        wakes: How many those are.
    """

    sent: int = 0
    lost: int = 0
    arrived: int = 0
    copies: int = 0
    late: int = 0
    delays: float = 0.0
    squares: float = 0.0
    steps: float = 0.0
    pairs: int = 0
    inside: int = 0
    places: float = 0.0
    place_squares: float = 0.0
    trips: float = 0.0
    trip_count: int = 0
    timed: int = 0
    lateness: float = 0.0
    late_squares: float = 0.0
    late_cubes: float = 0.0
    wakes: int = 0

    def add(self, other: Block) -> None:
        """Take the sums of another block on top."""
        for name in self.__slots__:
            setattr(self, name, getattr(self, name) + getattr(other, name))

    def measured(self, jitter: float) -> Measured:
        """Turn sums into what probes would have measured.

        Args:
            jitter: Asked for, the unit of places [s].
        """
        place = self.places / self.inside if self.inside else nan
        spread = max(0.0, self.place_squares / self.inside - place * place) if self.inside else nan
        mean = self.delays / self.timed if self.timed else nan
        variance = max(0.0, self.squares / self.timed - mean * mean) if self.timed else nan
        return Measured(
            sent=self.sent,
            lost=self.lost,
            doubled=self.copies,
            mean=mean,
            deviation=variance**0.5,
            variation=self.steps / self.pairs if self.pairs else nan,
            reordered=self.late / self.arrived if self.arrived else nan,
            middle=spread**0.5 * jitter,
        )
