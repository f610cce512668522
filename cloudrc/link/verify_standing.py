"""The link judged in flight by the tunnel's own datagrams: sums over blocks in, rows out.

Telemetry and commands are probes already: numbered, stamped, 100 a second each way. One-way delays
are known where both ends share a clock; else the round trips that cloud measures are judged.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace
from math import ceil, inf, isnan, nan
from typing import NamedTuple

from cloudrc.link.profile import DirectionProfile
from cloudrc.link.verify_block import Block
from cloudrc.link.verify_corrupt import refusing
from cloudrc.link.verify_ends import PERIOD, added, allowing, excused, scattered
from cloudrc.link.verify_estimate import REACHES
from cloudrc.link.verify_expect import (
    JITTER_SHARES_TAILED,
    Expectation,
    Schedule,
    draw_batches,
    expect,
    has_jitter,
    is_steady,
    is_tailed,
)
from cloudrc.link.verify_judge import Row, judge_quantity
from cloudrc.link.verify_ladder import Ladder
from cloudrc.link.verify_plan import needed_losses
from cloudrc.link.verify_quantity import Quantity
from cloudrc.link.verify_trips import Trips, round_trips

WINDOW_MAX = 26_000
"""Datagrams that are judged together at most: those of 260 s."""
RECENT = 3000
"""What is off by far is told by so many newest ones, however many decide that all is well."""
BATCHES = 96
_PATIENCE = 12_000
"""A jitter with a long tail that takes more is judged more loosely, which is said."""
_ENDLESS = 1_000_000
"""A number of datagrams that is as good as none [1]."""


class Needed(NamedTuple):
    """How many datagrams [1] decide a quantity; infinite if none do."""

    name: str
    datagrams: float


@dataclass(frozen=True, slots=True)
class Standing:
    """What a direction in flight is judged by.

    Attributes:
        profile: What is asked, as an end meets it that refuses what is damaged.
        expects: What the datagrams should measure, whatever the ends add but for its scatter.
        loss: Judges how many are lost.
        copies: Judges how many arrive twice.
        losses_need: Datagrams that decide how many are lost.
        copies_need: Likewise how many arrive twice.
        trips: What round trips should be; None where nobody measures them.
        roughness: How far the delays of neighbours should differ, in standard deviations [1].
    """

    profile: DirectionProfile
    expects: Expectation
    loss: Ladder
    copies: Ladder
    losses_need: int
    copies_need: int
    trips: Trips | None
    roughness: float

    def place(self, delay: float) -> float:
        """Say where in the middle a delay [s] is, in units of jitter; NaN if it is not there."""
        jitter = self.profile.jitter
        if not jitter:
            return nan
        below, above = REACHES[self.profile.distribution]
        place = (delay - self.profile.delay) / jitter
        return place if -below <= place <= above else nan

    def window(self, *, timed: bool) -> int:
        """Say how many datagrams are judged together: they decide every quantity that they can.

        Args:
            timed: Whether their delays are known.
        """
        needed = self.needed(Block(timed=int(timed), trip_count=int(not timed)))
        return int(min(WINDOW_MAX, max(one.datagrams for one in needed)))

    def rows(self, block: Block) -> list[Row]:
        """Judge what has arrived."""
        measured, count = block.measured(self.profile.jitter), max(1, block.sent)
        rows = [
            judge_quantity(name, asked, getattr(measured, name), count)
            for name, asked in self._delays(block)
        ]
        trip = self._trip(block)
        if trip is not None:
            mean = block.trips / block.trip_count
            rows.append(judge_quantity("round_trip", trip, mean, block.trip_count))
        rows = [_as_asked(row, self._mean(block), trip) for row in rows]
        rows.append(self.loss.row(measured.lost, measured.sent))
        late = judge_quantity("reordered", self.expects.reordered, measured.reordered, count)
        rows.append(late._replace(unit="1"))
        rows.append(self.copies.row(measured.doubled, measured.arrived))
        hopeless = {one.name for one in self.hopeless(block)}
        return [excused(_settled(row, hopeless), block) for row in rows]

    def needed(self, block: Block) -> list[Needed]:
        """Say how many datagrams decide each quantity that is judged.

        Args:
            block: What has arrived: tells which are known, and how late the ends are.
        """
        quantities = [*self._delays(block), ("reordered", self.expects.reordered)]
        found = [Needed(name, _finite(one.needs())) for name, one in quantities]
        found += [Needed("loss", self.losses_need), Needed("duplicated", self.copies_need)]
        trip = self._trip(block)
        if trip is not None and self.trips is not None:
            found.append(Needed("round_trip", _finite(trip.needs() / self.trips.share)))
        return found

    def hopeless(self, block: Block) -> list[Needed]:
        """Choose the quantities that take more datagrams than are kept: they are not waited for."""
        return [one for one in self.needed(block) if one.datagrams > WINDOW_MAX]

    def unlike(self, block: Block) -> float:
        """Say how far what has arrived is from what is asked in what is no matter of scale [1].

        By how rough it is, and by its copies: who shapes otherwise shows there, while a link that
        is off in delay or jitter does not.
        """
        measured, far = block.measured(self.profile.jitter), 0.0
        if self.roughness and measured.deviation > 0.0 and not isnan(measured.variation):
            far += abs(measured.variation / measured.deviation / self.roughness - 1.0)
        if self.profile.duplicate:
            far += abs(measured.doubled / max(1, measured.arrived) / self.profile.duplicate - 1.0)
        return far

    def _mean(self, block: Block) -> Quantity:
        return allowing(self.expects.mean, added(block, 1))

    def _trip(self, block: Block) -> Quantity | None:
        """Give what is expected of round trips; None where delays are known, or no trip is."""
        if self.trips is None or block.timed or not block.trip_count:
            return None
        return allowing(self.trips.mean, self.trips.rounding + added(block, 2))

    def _delays(self, block: Block) -> Iterator[tuple[str, Quantity]]:
        """Give what is expected of delays, if they are known."""
        if not block.timed:
            return
        yield "mean", self._mean(block)
        for name in ("deviation", "variation", "middle"):
            quantity: Quantity | None = getattr(self.expects, name)
            if quantity is not None:
                yield name, quantity


def _finite(number: float) -> float:
    return float(ceil(number)) if number < _ENDLESS else inf


def _as_asked(row: Row, mean: Quantity, trip: Quantity | None) -> Row:
    """Tell what the link was asked for, not what is expected with what the ends add."""
    expected = {"mean": mean, "round_trip": trip}.get(row.name)
    return row if expected is None else row._replace(asked=row.asked - expected.blur)


def _settled(row: Row, hopeless: set[str]) -> Row:
    """Leave nothing open that is never decided: what is not far off is told."""
    if row.verdict == "open" and row.name in hopeless:
        return row._replace(verdict="told")
    return row


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
    schedule = Schedule(PERIOD, 0, size)
    for share in JITTER_SHARES_TAILED:
        expects = _with_scatter(expect(profile, schedule, share, batches=BATCHES))
        if _jitter_needs(expects) <= _PATIENCE or not (has_jitter(profile) and is_tailed(profile)):
            break
    most = 8 * WINDOW_MAX
    losses, copies = (needed_losses(one, most) for one in (profile.loss, profile.duplicate))
    steady = other is not None and is_steady(other)
    return Standing(
        profile,
        expects,
        Ladder("loss", profile.loss, min(losses, WINDOW_MAX)),
        Ladder("duplicated", profile.duplicate, min(copies, WINDOW_MAX)),
        losses,
        copies,
        round_trips(profile, refusing(other), size) if other is not None and steady else None,
        _roughness(profile, schedule),
    )


def _with_scatter(asked: Expectation) -> Expectation:
    """Allow for the scatter of what the ends add."""
    variation, middle = asked.variation, asked.middle
    return replace(
        asked,
        deviation=scattered(asked.deviation),
        variation=variation and scattered(variation),
        middle=middle and scattered(middle),
    )


def _jitter_needs(expects: Expectation) -> int:
    """Count the datagrams that decide the quantities which tell of the jitter."""
    telling = (expects.deviation, expects.variation, expects.middle)
    return max(one.needs() for one in telling if one is not None)


def _roughness(profile: DirectionProfile, schedule: Schedule) -> float:
    """See `Standing`; 0 without jitter."""
    if not has_jitter(profile):
        return 0.0
    found = draw_batches(profile, schedule, BATCHES).estimates(None)
    deviation = found.deviation.value
    return found.variation.value / deviation if deviation else 0.0


def verdict_of(rows: Iterable[Row]) -> str:
    """Sum rows up: "off" if one is, else "open" if one is, else "ok"."""
    verdicts = {row.verdict for row in rows} - {"told"}
    return "off" if "off" in verdicts else "open" if "open" in verdicts or not verdicts else "ok"
