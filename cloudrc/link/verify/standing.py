"""The link judged in flight by the tunnel's own datagrams: sums over blocks in, rows out.

Telemetry and commands are probes already: numbered, stamped, 100 a second each way. One-way delays
are known where both ends share a clock; else the round trips that cloud measures are judged.

Which counts of losses are believed, for windows of any length: worked out before it is asked.

The exact chances of a few thousand packets take milliseconds, which no loop has to spare in flight.

What the ends of a flight add to the delays that they measure: how late they wake comes in.

A link is not to blame for it, nor may it hide behind it: more datagrams are taken for it.

Round trips as cloud measures them: profiles of both directions come in, an expectation goes out.

Newest-wins passes on the faster datagrams of each direction, and cloud notes the newest round trip
once a period, so that it is not the sum of two mean delays. World applies a command with the next
tick of its simulation: by how much that rounds up depends on when cloud's periods begin in world's,
which nobody knows; jitter evens it out, and what it leaves is allowed for.

What datagrams show on the link that a shaper says it makes: a profile in, numbers out.

A link that changes over time, judged without its draws: where on its time line it is, is known.

As `link verify` judges one: delays about what is asked at that time, losses stretch by stretch.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace
from math import ceil, hypot, inf, isnan, nan
from typing import NamedTuple

import numpy as np

from cloudrc.link.profile import DirectionProfile, Loss, mean_loss
from cloudrc.link.verify.expect import (
    JITTER_SHARES_TAILED,
    MEAN_FLOOR,
    MEAN_SHARE,
    Expectation,
    Schedule,
    as_sent,
    draw_batches,
    expect,
    has_jitter,
    is_steady,
    is_tailed,
    netem_makes,
    refusing,
    share_margin,
)
from cloudrc.link.verify.judge import RATE_SHARE, Row, Verdict, judge, judge_quantity
from cloudrc.link.verify.measure import Block, Log, measure
from cloudrc.link.verify.plan import Plan, bounds, is_told, needed_losses, plausible, stretches_of
from cloudrc.link.verify.reference import (
    ALARM,
    MISS,
    REACHES,
    Floats,
    Quantity,
    draw,
    frame_of,
    instants,
)
from cloudrc.link.verify.twin import Pairs

_FIRST, _STEP = 500, 1.3


@dataclass(frozen=True, slots=True)
class _Rung:
    """For `count` packets: shares that are believed, and whether a true link is sure to be."""

    count: int
    low: float
    high: float
    decides: bool


class Ladder:
    """Judges one count."""

    def __init__(self, name: str, loss: Loss, needs: int) -> None:
        """Work out windows up to what is needed; takes some 100 ms if that is many.

        Args:
            name: Of the row.
            loss: What chance counts.
            needs: Packets that decide.
        """
        self._name, self._asked = name, mean_loss(loss)
        counts = [_FIRST]
        while counts[-1] < needs:
            counts.append(min(needs, ceil(counts[-1] * _STEP)))
        self._rungs = [_rung(loss, count) for count in counts]

    def row(self, found: int, count: int) -> Row:
        """Judge so many of `count` packets; a longer window than worked out is as good as that."""
        below = [rung for rung in self._rungs if rung.count <= count]
        share = found / count if count else nan
        if not below:
            return Row(self._name, "1", self._asked, nan, share, 0.0, 1.0, "open")
        rung = below[-1]
        inside = rung.low <= share <= rung.high
        verdict: Verdict = ("ok" if rung.decides else "open") if inside else "off"
        return Row(self._name, "1", self._asked, nan, share, rung.low, rung.high, verdict)


def _rung(loss: Loss, count: int) -> _Rung:
    asked, margin = [(count, loss)], share_margin(mean_loss(loss))
    allowed = bounds(asked, margin, MISS)
    decides = is_told(asked, allowed)
    if not decides:  # only what is far off can be told by so few
        allowed = plausible(asked, margin, ALARM)
    return _Rung(count, allowed.low / count, allowed.high / count, decides)


PERIOD = 0.01
"""Of telemetry and of commands [s]."""
ENDS = 1e-3
"""What the ends themselves add to a delay, at most: a command's own computation, two wakes [s]."""
ENDS_LEAST = 2e-4
"""What they add at most if they wake in time: two ways through a kernel [s]."""
ENDS_SCATTER = 3e-4
"""How what they add scatters [s]."""
LATE_FACTOR = 2.0
"""The other end, whose lateness this one does not know, is taken to be as late."""


def added(block: Block, ways: int) -> float:
    """Say what the ends have added at most to a delay of one way, or of both [s].

    They are taken to be as late as this one was found to be; where that is not known, or they are
    later than they should be, to be late by ENDS for each way.
    """
    most = ways * ENDS
    if not block.wakes:
        return most
    return min(most, ways * ENDS_LEAST + LATE_FACTOR * _waited(block) / block.wakes)


def allowing(asked: Quantity, most: float) -> Quantity:
    """Allow for what ends add to a mean: half of `most` [s] is expected, and as much either side.

    Margins stay where they were: what is off by one has to be told whatever the ends add.
    """
    half = most / 2.0
    return replace(asked, expected=asked.expected + half, margin=asked.margin - half, blur=half)


def scattered(asked: Quantity) -> Quantity:
    """Allow for what ends add to a number that tells of jitter."""
    return replace(asked, blur=hypot(asked.expected, ENDS_SCATTER) - asked.expected)


def excused(row: Row, block: Block) -> Row:
    """Do not blame the link for delays that ends which wake so late may have added.

    In a wake that is late by L, L / PERIOD datagrams have waited for L / 2 in the mean: a long one
    weighs more than many short ones.
    """
    if row.verdict != "off" or not block.wakes or row.measured < row.low:
        return row
    wakes, most = block.wakes, row.high
    if row.name in ("mean", "round_trip"):
        most += LATE_FACTOR * _waited(block) / wakes
    elif row.name in ("deviation", "variation", "middle"):
        waited = max(block.late_squares, block.late_cubes / (3.0 * PERIOD))
        most = hypot(most, LATE_FACTOR * (waited / wakes) ** 0.5)
    return row._replace(verdict="open") if row.measured <= most else row


def _waited(block: Block) -> float:
    """Sum up over all wakes what datagrams have waited in them [s]."""
    return max(block.lateness, block.late_squares / (2.0 * PERIOD))


TICK = 2e-3
"""From one tick of world's simulation to the next [s]."""
_PHASES = [(tick + edge) * TICK for tick in range(round(PERIOD / TICK)) for edge in (0.01, 0.99)]
"""Beginnings of cloud's periods in world's that are tried: just after a tick, and before [s]."""
_SEED = 20250522
_RUNS, _COUNT, _BURN_IN = 48, 1000, 200


@dataclass(frozen=True, slots=True)
class Trips:
    """What is expected of round trips.

    Attributes:
        mean: Of theirs, where cloud's periods begin so that they are shortest, without what the
            ends add [s].
        rounding: How much longer they may be where cloud's periods begin otherwise [s].
        share: How many there are for each datagram [1].
    """

    mean: Quantity
    rounding: float
    share: float


def round_trips(up: DirectionProfile, down: DirectionProfile, size: int) -> Trips | None:
    """Expect of round trips: that of the newest command applied, echoed by the newest odometry.

    Args:
        up: What is asked of the uplink, which does not change.
        down: Of the downlink, likewise.
        size: Of a datagram, UDP payload [bytes].

    Returns:
        None if there are none: nothing passes.
    """
    rng = np.random.default_rng(_SEED)
    sent = instants(_COUNT, PERIOD)
    there = draw(up, sent, size, _RUNS, rng)
    back = draw(down, sent, size, _RUNS, rng)
    there_at = np.where(there.arrived, sent + there.delay, np.inf)
    back_at = np.where(back.arrived, sent + back.delay, np.inf)
    # The same chance for every phase: what differs is its doing.
    trips = [
        [_trips(there_at[run], back_at[run] + phase, sent, phase) for run in range(_RUNS)]
        for phase in _PHASES
    ]
    if not all(len(one) for runs in trips for one in runs):
        return None
    means = [float(np.concatenate(runs).mean()) for runs in trips]
    batches = np.array([[one.mean() for one in runs] for runs in trips])
    number = sum(len(one) for runs in trips for one in runs) / (_RUNS * len(_PHASES))
    spread = float(batches.std(axis=1).max()) * number**0.5
    residual = (batches - batches.mean(axis=1, keepdims=True)).ravel()
    deviation = float(residual.std())
    skew = float((residual**3).mean() / deviation**3) if deviation > 1e-9 else 0.0
    least, margin = min(means), max(MEAN_FLOOR, MEAN_SHARE * float(np.mean(means)))
    mean = Quantity(least, spread, skew, max(1, round(number)), margin)
    return Trips(mean, max(means) - least, number / (_COUNT - _BURN_IN))


def _trips(up: Floats, down: Floats, sent: Floats, phase: float) -> Floats:
    """Give the round trips [s] that cloud notes in one flight.

    Args:
        up: When each odometry arrives at cloud [s], shape (n,); infinite if it is lost.
        down: When each command arrives at world [s], likewise.
        sent: When each odometry leaves world [s], shape (n,); commands leave `phase` later.
        phase: When a period of cloud's begins, in one of world's [s].
    """
    applied = np.ceil(down / TICK - 1e-9) * TICK
    echoed = _newest(applied, sent)  # by each odometry
    # What leaves an orderly link at one instant comes in its order.
    used = up <= np.minimum.accumulate(np.append(up[1:], np.inf)[::-1])[::-1]
    chosen = np.flatnonzero(used & np.isfinite(up) & (echoed >= 0))
    fresh = chosen[np.append(True, np.diff(echoed[chosen]) > 0)] if len(chosen) else chosen
    period = np.ceil((up[fresh] - phase) / PERIOD - 1e-9)  # in which cloud notes it
    noted = fresh[np.append(np.diff(period) > 0, True)] if len(fresh) else fresh
    noted = noted[noted >= _BURN_IN]
    trips: Floats = (up[noted] - sent[noted]) + (applied - sent - phase)[echoed[noted]]
    return trips


def _newest(arrival: Floats, at: Floats) -> np.ndarray[tuple[int, ...], np.dtype[np.int64]]:
    """Say which is the newest that has arrived at each instant [s]; -1 if none has."""
    order = np.argsort(arrival, kind="stable")
    newest = np.maximum.accumulate(order)
    place = np.searchsorted(arrival[order], at + 1e-9, side="right") - 1
    return np.where(place >= 0, newest[np.maximum(place, 0)], -1)


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


def shown(applied: DirectionProfile, size: int, shaper: str) -> dict[str, float]:
    """Work out what the tunnel's own datagrams show, as the standing check does; takes 50 ms.

    Args:
        applied: What is in force, for ever.
        size: Of each datagram, UDP payload [bytes].
        shaper: "relay" or "netem".

    Returns:
        By the name of the row: [s] or [1].
    """
    profile = netem_makes(applied) if shaper == "netem" else refusing(applied)
    found = draw_batches(profile, Schedule(PERIOD, 0, size), BATCHES).estimates(None)
    shares = {"loss": mean_loss(profile.loss), "duplicated": profile.duplicate}
    return {name: one.value for name, one in found._asdict().items()} | shares


def rate_in_force(asked: float, applied: float) -> Iterator[Row]:
    """Judge a rate that nobody measures by what the shaper says; nothing if that is right.

    Args:
        asked: Of the bottleneck [bit/s].
        applied: By the shaper's word [bit/s]; infinite without one.
    """
    low, high = (1.0 - RATE_SHARE) * asked, (1.0 + RATE_SHARE) * asked
    if not low <= applied <= high:
        yield Row("rate", "bit/s", asked, applied, nan, low, high, "off")


_BATCHES = 384


def judge_story(profile: DirectionProfile, pairs: Pairs, size: int) -> list[Row]:
    """Judge datagrams of a link that changes, as netem makes it; takes some 100 ms.

    Args:
        profile: What is asked, with its time line.
        pairs: What was heard, and when since the time line began it was sent.
        size: Of each, UDP payload [bytes].
    """
    profile, count = netem_makes(profile), len(pairs.sent)
    period = float(pairs.sent[-1] - pairs.sent[0]) / (count - 1)
    schedule = Schedule(period, count, size, float(pairs.sent[0]))
    expects = expect(profile, schedule, batches=_BATCHES)
    expects = as_sent(expects, profile, np.maximum.accumulate(pairs.sent), size)
    stretches = tuple(stretches_of(profile, schedule))
    plan = Plan(profile, schedule, expects, stretches, expects.needs())
    measured = measure(_log(pairs), expects.over_time, frame=frame_of(profile, pairs.sent))
    return [row for row in judge(plan, measured) if row.name != "corrupted"]


def _log(pairs: Pairs) -> Log:
    """Write down when what was sent and arrived, to whole nanoseconds."""
    sent_ns = np.rint(pairs.sent * 1e9).astype(np.int64)
    delay_ns = np.rint(np.where(pairs.arrived, pairs.heard, 0.0) * 1e9).astype(np.int64)
    arrivals = [
        (place, int(sent_ns[place] + delay_ns[place]))
        for place in np.flatnonzero(pairs.arrived).tolist()
        for _ in range(int(pairs.copies[place]))
    ]
    return Log(sent_ns.tolist(), arrivals)
