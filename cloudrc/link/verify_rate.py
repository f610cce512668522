"""The rate of a bottleneck, by trains of probes: how far a train is drawn out tells it.

A train of large packets leaves at once and waits at the bottleneck, which lets one through at a
time. Jitter draws it out as well, so what is expected comes from the reference, as for delays.

Source: M. Jain, C. Dovrolis, "Packet-dispersion techniques and a capacity-estimation methodology",
IEEE/ACM Trans. Networking 12, 2004.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace
from math import ceil, inf

import numpy as np

from cloudrc.link.profile import Change, DirectionProfile
from cloudrc.link.timeline import Timeline
from cloudrc.link.verify_quantity import Quantity
from cloudrc.link.verify_reference import WIRE_BYTES, Floats, draw, instants

SIZE = 1400
"""Of a packet in a train, UDP payload [bytes]: near the largest that is not cut on its way."""
RATE_SHARE = 0.25
"""By which share a rate may be off."""

_LENGTH_MAX, _LENGTH_MIN = 64, 4
_LONG_ENOUGH = 0.06
"""To draw a train out further [s] proves no more."""
_TRAINS_MAX, _TRAINS_MIN = 150, 8
_SENT_WITHIN = 2e-5
"""From one packet of a train to the next as they are sent [s]."""
_REST, _LONGEST = 0.03, 45.0
_RUNS = 1500
_SEED = 20250521


@dataclass(frozen=True, slots=True)
class Trains:
    """How to probe a bottleneck, and what to expect.

    Attributes:
        rate: Asked for [bit/s].
        length: Packets in a train.
        count: Trains.
        period: From one to the next [s].
        span: What the mean time from a train's first arrival to its last should be [s].
        judges: "rate" if one that is off by a quarter is told, "limit" if only whether there is
            any, "" if not even that: too fast for its jitter.
    """

    rate: float
    length: int
    count: int
    period: float
    span: Quantity
    judges: str

    @property
    def duration(self) -> float:
        """Time that it takes to send them [s]."""
        return self.count * self.period

    def measured(self, span: float) -> float:
        """Turn a mean span [s] into a rate [bit/s]: what jitter adds to it is as expected."""
        wire = (self.length - 1) * (SIZE + WIRE_BYTES) * 8.0
        drawn_out = span - (self.span.expected - wire / self.rate)
        return wire / drawn_out if drawn_out > 0.0 else inf


def plan_trains(profile: DirectionProfile, begin: float) -> Trains | None:
    """Choose trains for a direction that begin so long after the link came up [s].

    Returns:
        None if no rate is asked for then.
    """
    now = Timeline(profile).at(round(begin * 1e9))
    if now.rate is None:
        return None
    wire = (SIZE + WIRE_BYTES) * 8.0 / now.rate
    length = max(
        _LENGTH_MIN, min(_LENGTH_MAX, profile.queue_packets // 2, ceil(_LONG_ENOUGH / wire))
    )
    spans = _spans(profile, length, begin)
    rest = _REST + length * wire * 1.5 + 4.0 * float(spans.std())
    most = max(_TRAINS_MIN, min(_TRAINS_MAX, int(_LONGEST / rest)))
    mean = float(spans.mean())

    def margin(*factors: float) -> float:
        others = (_spans(_faster(profile, factor), length, begin).mean() for factor in factors)
        return float(min(abs(other - mean) for other in others))

    for judges, factors in (("rate", (1.0 - RATE_SHARE, 1.0 + RATE_SHARE)), ("limit", (0.5, inf))):
        span = _quantity(spans, margin(*factors))
        needs = max(_TRAINS_MIN, span.needs())
        if needs <= most:
            return Trains(now.rate, length, needs, rest, span, judges)
    return Trains(now.rate, length, 0, rest, _quantity(spans, inf), "")


def spans(sent: int, length: int, arrivals: Iterable[tuple[int, int]]) -> list[float]:
    """Say how far each train was drawn out [s].

    Args:
        sent: How many trains.
        length: Packets in each.
        arrivals: Number of the packet, counted through all trains, and when it arrived [ns].
    """
    first, last = [0] * sent, [0] * sent
    for number, at_ns in arrivals:
        train = number // length
        first[train] = min(first[train] or at_ns, at_ns)
        last[train] = max(last[train], at_ns)
    return [(b - a) * 1e-9 for a, b in zip(first, last, strict=True) if b > a > 0]


def _spans(profile: DirectionProfile, length: int, begin: float) -> Floats:
    sent = instants(length, _SENT_WITHIN, begin)
    fates = draw(profile, sent, SIZE, _RUNS, np.random.default_rng(_SEED))
    arrival = sent + fates.delay
    last = np.where(fates.arrived, arrival, -inf).max(axis=1)
    first = np.where(fates.arrived, arrival, inf).min(axis=1)
    drawn_out: Floats = last - first
    return drawn_out[np.isfinite(drawn_out) & (drawn_out > 0.0)]


def _quantity(spans: Floats, margin: float) -> Quantity:
    deviation, mean = float(spans.std()), float(spans.mean())
    skew = float(((spans - mean) ** 3).mean() / deviation**3) if deviation > 1e-7 else 0.0
    return Quantity(mean, deviation, skew, 1, margin)


def _faster(profile: DirectionProfile, factor: float) -> DirectionProfile:
    """Let all its rates be off by a factor; an infinite one has none."""

    def scaled(rate: float | None) -> float | None:
        return None if rate is None else (1e15 if factor == inf else factor * rate)

    changes: tuple[Change, ...] = tuple(
        replace(change, rate=scaled(change.rate)) for change in profile.changes
    )
    return replace(profile, rate=scaled(profile.rate), changes=changes)
