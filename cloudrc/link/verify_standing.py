"""The link judged in flight, by the tunnel's own datagrams: sums over blocks in, rows out.

Telemetry and commands are probes already: numbered, stamped, 100 a second each way. One-way delays
are known where both ends share a clock; else the round trips that cloud measures are judged, of
which newest-wins passes on the faster ones: what they should be comes from the reference, too.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace
from math import nan

import numpy as np

from cloudrc.link.profile import DirectionProfile
from cloudrc.link.verify_expect import (
    MEAN_FLOOR,
    MEAN_SHARE,
    Expectation,
    Schedule,
    expect,
    is_steady,
    share_margin,
)
from cloudrc.link.verify_judge import Row, judge, judge_quantity
from cloudrc.link.verify_loss import bounds, mean_of
from cloudrc.link.verify_measure import Measured
from cloudrc.link.verify_plan import Plan, needed, stretches_of
from cloudrc.link.verify_quantity import MISS, Quantity
from cloudrc.link.verify_reference import Floats, draw, instants

PERIOD = 0.01
"""Of telemetry and of commands [s]."""
ENDS = 2e-3
"""What the ends themselves may add to a delay: a command's own computation, a wake [s]."""
LATE_FACTOR = 2.0
"""The other end, whose lateness this one does not know, is taken to be as late."""
WINDOW_MAX = 9000
"""Datagrams that are judged together at most: those of 90 s."""
_WINDOW_MIN = 1000
_BATCHES = 48
_SEED = 20250522
_RUNS, _COUNT, _BURN_IN = 48, 1000, 200


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
        trips: Sum of round trips [s].
        trip_count: How many those are.
        timed: Of those that arrived, how many had a delay.
        lateness: Sum of what this end's wakes were late and busy [s].
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
    trips: float = 0.0
    trip_count: int = 0
    timed: int = 0
    lateness: float = 0.0
    wakes: int = 0

    def add(self, other: Block) -> None:
        """Take the sums of another block on top."""
        for name in self.__slots__:
            setattr(self, name, getattr(self, name) + getattr(other, name))

    def measured(self) -> Measured:
        """Turn sums into what probes would have measured."""
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
        )


@dataclass(frozen=True, slots=True)
class Standing:
    """What a direction in flight is judged by.

    Attributes:
        plan: For one-way delays, losses and order.
        trip: What round trips should be in the mean [s]; None where nobody measures them.
    """

    plan: Plan
    trip: Quantity | None

    @property
    def window(self) -> int:
        """Datagrams that are judged together."""
        return self.plan.schedule.count

    def rows(self, block: Block) -> list[Row]:
        """Judge what has arrived."""
        measured = block.measured()
        rows = judge(self.plan, measured)
        if not block.timed:
            rows = [row for row in rows if row.name not in ("mean", "deviation", "variation")]
            if self.trip is not None and block.trip_count:
                trip = block.trips / block.trip_count
                rows.insert(0, judge_quantity("round_trip", self.trip, trip, block.trip_count))
        late = LATE_FACTOR * block.lateness / block.wakes if block.wakes else 0.0
        return [_excused(row, late) for row in rows]


def _excused(row: Row, late: float) -> Row:
    """Do not blame the link for delays that ends which wake so late [s] may have added."""
    may = row.verdict == "off" and row.name in ("mean", "deviation", "variation", "round_trip")
    if may and row.low <= row.measured <= row.high + late:
        return row._replace(verdict="open")
    return row


def make_standing(
    profile: DirectionProfile, size: int, other: DirectionProfile | None = None
) -> Standing | None:
    """Work out what a direction in flight is judged by; takes some 50 ms.

    Args:
        profile: What is asked of it.
        size: Of its datagrams, UDP payload [bytes].
        other: What is asked of the way back, if this end measures round trips.

    Returns:
        None if its conditions change: no number of a flight then says what it should be.
    """
    if not is_steady(profile):
        return None
    schedule = Schedule(PERIOD, 0, size)
    expects = _lenient(expect(profile, schedule, batches=_BATCHES))
    needs = needed(profile, expects, WINDOW_MAX)
    count = max(_WINDOW_MIN, min(WINDOW_MAX, needs))
    schedule = replace(schedule, count=count)
    stretches = tuple(stretches_of(profile, schedule))
    lost = bounds(stretches, share_margin(mean_of(stretches)), MISS)
    plan = Plan(profile, schedule, expects, stretches, lost, needs)
    trip = None
    if other is not None and is_steady(other):
        trip = _round_trip(profile, other, size)
    return Standing(plan, trip)


def _lenient(asked: Expectation) -> Expectation:
    """Allow for what the ends add."""
    mean = replace(asked.mean, margin=asked.mean.margin + ENDS)
    deviation = replace(asked.deviation, margin=asked.deviation.margin + ENDS / 4.0)
    return replace(asked, mean=mean, deviation=deviation)


def _round_trip(up: DirectionProfile, down: DirectionProfile, size: int) -> Quantity:
    """Expect of round trips: that of the newest command applied, echoed by the newest odometry."""
    rng = np.random.default_rng(_SEED)
    sent = instants(_COUNT, PERIOD)
    there = draw(up, sent, size, _RUNS, rng)
    back = draw(down, sent, size, _RUNS, rng)
    trips = [
        _trips(
            np.where(there.arrived[run], sent + there.delay[run], np.inf),
            np.where(back.arrived[run], sent + back.delay[run], np.inf),
            sent,
        )
        for run in range(_RUNS)
    ]
    every = np.concatenate(trips)
    means = np.array([one.mean() for one in trips if len(one)])
    mean, batch = float(every.mean()), max(1, round(len(every) / _RUNS))
    spread = float(means.std()) * batch**0.5
    return Quantity(mean, spread, 0.0, batch, max(MEAN_FLOOR, MEAN_SHARE * mean) + 2.0 * ENDS)


def _trips(up: Floats, down: Floats, sent: Floats) -> Floats:
    """Give the round trips [s] that one flight measures.

    Args:
        up: When each odometry arrives at cloud [s], shape (n,); infinite if it is lost.
        down: When each command arrives at world [s], likewise.
        sent: When each leaves its end [s], shape (n,).
    """
    echoed = _newest(down, sent)  # by each odometry
    used = up < np.minimum.accumulate(np.append(up[1:], np.inf)[::-1])[::-1]
    chosen = np.flatnonzero(used & (echoed >= 0) & (np.arange(len(sent)) >= _BURN_IN))
    fresh = chosen[np.append(True, np.diff(echoed[chosen]) > 0)] if len(chosen) else chosen
    trips: Floats = (up[fresh] - sent[fresh]) + (down - sent)[echoed[fresh]]
    return trips


def _newest(arrival: Floats, at: Floats) -> np.ndarray[tuple[int, ...], np.dtype[np.int64]]:
    """Say which is the newest that has arrived at each instant [s]; -1 if none has."""
    order = np.argsort(arrival)
    newest = np.maximum.accumulate(order)
    place = np.searchsorted(arrival[order], at, side="right") - 1
    return np.where(place >= 0, newest[np.maximum(place, 0)], -1)


def verdict_of(rows: Iterable[Row]) -> str:
    """Sum rows up: "off" if one is, else "open" if one is, else "ok"."""
    verdicts = {row.verdict for row in rows}
    return "off" if "off" in verdicts else "open" if "open" in verdicts or not verdicts else "ok"
