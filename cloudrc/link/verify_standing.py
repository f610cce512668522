"""The link judged in flight by the tunnel's own datagrams: sums over blocks in, rows out.

Telemetry and commands are probes already: numbered, stamped, 100 a second each way. One-way delays
are known where both ends share a clock; else the round trips that cloud measures are judged, of
which newest-wins passes on the faster ones: what they should be comes from the reference, too.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace
from math import hypot, nan

import numpy as np

from cloudrc.link.profile import DirectionProfile
from cloudrc.link.verify_block import Block
from cloudrc.link.verify_corrupt import refusing
from cloudrc.link.verify_estimate import REACHES
from cloudrc.link.verify_expect import (
    JITTER_SHARES_TAILED,
    MEAN_FLOOR,
    MEAN_SHARE,
    Expectation,
    Schedule,
    expect,
    has_jitter,
    is_steady,
    is_tailed,
)
from cloudrc.link.verify_judge import Row, judge_quantity
from cloudrc.link.verify_ladder import Ladder
from cloudrc.link.verify_plan import needed_losses
from cloudrc.link.verify_quantity import Quantity
from cloudrc.link.verify_reference import Floats, draw, instants

PERIOD = 0.01
"""Of telemetry and of commands [s]."""
ENDS = 1e-3
"""What the ends themselves add to a delay, at most: a command's own computation, two wakes [s].
Allowed for by more datagrams, not by a wider margin."""
ENDS_SCATTER = 3e-4
"""How that scatters [s]."""
LATE_FACTOR = 2.0
"""The other end, whose lateness this one does not know, is taken to be as late."""
WINDOW_MAX = 25_000
"""Datagrams that are judged together at most: those of 250 s."""
RECENT = 3000
"""What is off by far is told by so many newest ones, however many decide that all is well."""
_PATIENCE = 12_000
"""A jitter with a long tail that takes more is judged more loosely, which is said."""
BATCHES = 96
_SEED = 20250522
_RUNS, _COUNT, _BURN_IN = 48, 1000, 200


@dataclass(frozen=True, slots=True)
class Standing:
    """What a direction in flight is judged by.

    Attributes:
        profile: What is asked, as an end meets it that refuses what is damaged.
        expects: What the datagrams should measure.
        loss: Judges how many are lost.
        copies: Judges how many arrive twice.
        window: Datagrams that are judged together: they decide every quantity, if so many can.
        needs: How many decide; more than the window if that cannot.
        trip: What round trips should be in the mean [s]; None where nobody measures them.
    """

    profile: DirectionProfile
    expects: Expectation
    loss: Ladder
    copies: Ladder
    window: int
    needs: int
    trip: Quantity | None

    def place(self, delay: float) -> float:
        """Say where in the middle a delay [s] is, in units of jitter; NaN if it is not there."""
        jitter = self.profile.jitter
        if not jitter:
            return nan
        below, above = REACHES[self.profile.distribution]
        place = (delay - self.profile.delay) / jitter
        return place if -below <= place <= above else nan

    def rows(self, block: Block) -> list[Row]:
        """Judge what has arrived."""
        measured, asked = block.measured(self.profile.jitter), self.expects
        rows, count = list[Row](), max(1, measured.sent)
        if block.timed:
            for name in ("mean", "deviation", "variation", "middle"):
                quantity: Quantity | None = getattr(asked, name)
                if quantity is not None:
                    rows.append(judge_quantity(name, quantity, getattr(measured, name), count))
            rows[0] = _as_asked(rows[0], asked.mean)
        elif self.trip is not None and block.trip_count:
            trip = block.trips / block.trip_count
            row = judge_quantity("round_trip", self.trip, trip, block.trip_count)
            rows.append(_as_asked(row, self.trip))
        rows.append(self.loss.row(measured.lost, measured.sent))
        late = judge_quantity("reordered", asked.reordered, measured.reordered, count)
        rows.append(late._replace(unit="1"))
        rows.append(self.copies.row(measured.doubled, measured.arrived))
        return [excused(row, block) for row in rows]


def _as_asked(row: Row, expected: Quantity) -> Row:
    """Tell what the link was asked for, not what is expected with what the ends add."""
    return row._replace(asked=row.asked - expected.blur)


def excused(row: Row, block: Block) -> Row:
    """Do not blame the link for delays that ends which wake so late may have added.

    In a wake that is late by L, L / PERIOD datagrams have waited for L / 2 in the mean: a long one
    weighs more than many short ones.
    """
    if row.verdict != "off" or not block.wakes or row.measured < row.low:
        return row
    wakes, most = block.wakes, row.high
    if row.name in ("mean", "round_trip"):
        waited = max(block.lateness, block.late_squares / (2.0 * PERIOD))
        most += LATE_FACTOR * waited / wakes
    elif row.name in ("deviation", "variation", "middle"):
        waited = max(block.late_squares, block.late_cubes / (3.0 * PERIOD))
        most = hypot(most, LATE_FACTOR * (waited / wakes) ** 0.5)
    return row._replace(verdict="open") if row.measured <= most else row


def make_standing(
    profile: DirectionProfile, size: int, other: DirectionProfile | None = None
) -> Standing:
    """Work out what a direction in flight is judged by; takes a second or two.

    Args:
        profile: What is asked of it.
        size: Of its datagrams, UDP payload [bytes].
        other: What is asked of the way back, if this end measures round trips.

    Raises:
        ValueError: If its conditions change: see `timeline.settled` for how they end.
    """
    if not is_steady(profile):
        raise ValueError("conditions change")
    profile = refusing(profile)
    schedule, most = Schedule(PERIOD, 0, size), WINDOW_MAX
    for share in JITTER_SHARES_TAILED:
        expects = _with_ends(expect(profile, schedule, share, batches=BATCHES))
        if expects.needs() <= _PATIENCE or not (has_jitter(profile) and is_tailed(profile)):
            break
    losses, copies = (needed_losses(one, 8 * most) for one in (profile.loss, profile.duplicate))
    needs = max(expects.needs(), losses, copies)
    trip = None
    if other is not None and is_steady(other):
        trip = _round_trip(profile, refusing(other), size)
        needs = max(needs, trip.needs())
    return Standing(
        profile,
        expects,
        Ladder("loss", profile.loss, min(losses, most)),
        Ladder("duplicated", profile.duplicate, min(copies, most)),
        min(needs, WINDOW_MAX),
        needs,
        trip,
    )


def _with_ends(asked: Expectation) -> Expectation:
    """Allow for what the ends add: half of ENDS is expected, and as much to either side of it."""
    mean, half = asked.mean, ENDS / 2.0
    # Margins stay where they were: what is off by one has to be told whatever the ends add.
    mean = replace(mean, expected=mean.expected + half, margin=mean.margin - half, blur=half)

    def scattered(one: Quantity | None) -> Quantity | None:
        if one is None:
            return None
        return replace(one, blur=hypot(one.expected, ENDS_SCATTER) - one.expected)

    deviation = scattered(asked.deviation) or asked.deviation
    return replace(
        asked,
        mean=mean,
        deviation=deviation,
        variation=scattered(asked.variation),
        middle=scattered(asked.middle),
    )


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
    margin = max(MEAN_FLOOR, MEAN_SHARE * mean) - ENDS
    return Quantity(mean + ENDS, spread, 0.0, batch, margin, blur=ENDS)


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
    verdicts = {row.verdict for row in rows} - {"told"}
    return "off" if "off" in verdicts else "open" if "open" in verdicts or not verdicts else "ok"
