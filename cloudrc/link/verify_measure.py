"""What the probes of one direction measured: instants of sending and arrival in, numbers out."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from math import nan

import numpy as np

from cloudrc.link.verify_estimate import Frame
from cloudrc.link.verify_reference import Flags, Floats, overtaken


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
