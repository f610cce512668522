"""The link's own draws beside what was heard: datagrams of a flight come in, rows go out.

Chance depends on seed, direction, epoch and counter alone, so whoever knows these knows what befell
datagram n. What the drawn fates leave over is hardly any scatter: a few thousand datagrams prove
rare bursts, long tails and time lines which statistics would take many minutes for. Only the relay
draws so; of netem nothing fits, which is no fault: then the statistics decide.

What drawn fates and heard ones differ by, judged: pairs of them come in, rows go out.

When a time line began, by what was heard: delays over time come in, its beginning goes out.

The end that hears a direction is not told: the shaper runs in the other pod. But delays that change
tell where on its time line a link is.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from math import inf, nan
from typing import NamedTuple

import numpy as np

from cloudrc.link.model import LinkDirection
from cloudrc.link.profile import DirectionProfile, GilbertElliott, Loss, Timeline
from cloudrc.link.verify.expect import (
    DEVIATION_FLOOR,
    JITTER_SHARES,
    MEAN_FLOOR,
    MEAN_SHARE,
    has_jitter,
    scaled,
    share_margin,
)
from cloudrc.link.verify.judge import Row, Verdict
from cloudrc.link.verify.plan import chances
from cloudrc.link.verify.reference import MISS, Z_MISS, Flags, Floats, Frame, frame_of, overtaken

FEWEST = 1000
"""Datagrams that are compared at least."""


@dataclass(frozen=True, slots=True)
class Pairs:
    """Datagrams in the order of their counters: what was drawn, and what was heard.

    Attributes:
        sent: When each left [s], since its time line began, shape (n,).
        heard: Delay [s], shape (n,); NaN if it did not arrive.
        drawn: Likewise.
        arrived: Whether it arrived, shape (n,).
        drawn_copies: How many copies should, shape (n,).
        copies: How many did, shape (n,).
    """

    sent: Floats
    heard: Floats
    drawn: Floats
    arrived: Flags
    drawn_copies: Floats
    copies: Floats

    @property
    def timed(self) -> Flags:
        """Which arrived, should have, and have a delay."""
        return np.isfinite(self.heard) & np.isfinite(self.drawn)


def judged(
    profile: DirectionProfile, pairs: Pairs, off: tuple[Floats, Floats] | None = None
) -> list[Row]:
    """Judge all that can be: without a shared clock neither delays nor their order.

    Args:
        profile: What is asked.
        pairs: At least FEWEST of them.
        off: What would be drawn if the jitter were off by its margin, less and more [s], shape
            (n,); None where that follows from what is drawn, as no datagram waits for others.
    """
    rows = [*_delay_rows(profile, pairs, off)] if pairs.timed.any() else []
    rows.append(_loss_row(profile, pairs))
    if pairs.timed.any():
        rows.append(_reordered_row(pairs))
    there = max(1, int(pairs.arrived.sum()))
    doubled = (pairs.drawn_copies > 1) & pairs.arrived
    asked, measured = float(doubled.sum()) / there, float((pairs.copies > 1).sum()) / there
    rows.append(_share_row("duplicated", asked, measured, there))
    return rows


def _delay_rows(
    profile: DirectionProfile, pairs: Pairs, off: tuple[Floats, Floats] | None
) -> list[Row]:
    """Judge mean and scatter of the delays.

    What the ends add is never negative, so that a link which is too quick is told from half its
    margin on, and one that is too slow not later than at its margin.
    """
    timed = pairs.timed
    heard, drawn = pairs.heard[timed], pairs.drawn[timed]
    rest = heard - drawn
    noise = Z_MISS * float(rest.std()) / len(rest) ** 0.5
    mean = float(drawn.mean())
    margin = max(MEAN_FLOOR, MEAN_SHARE * mean)
    low, high = mean - 0.5 * margin, mean + margin - noise
    rows = [_row("mean", "s", mean, float(heard.mean()), (low, high))]
    scatter = float(drawn.std())
    allowed = max(DEVIATION_FLOOR, JITTER_SHARES[0] * scatter)
    bounds = scatter - allowed, scatter + allowed
    rows.append(_row("deviation", "s", scatter, float(heard.std()), bounds))
    frame = frame_of(profile, pairs.sent)
    inside, place = frame.look(np.where(timed, pairs.drawn, 0.0), timed)
    spread = float(place[inside].std()) if inside.sum() > FEWEST // 4 else 0.0
    if spread > 0.0 and frame.unit > 0.0:
        rows.append(_jitter_row(pairs, (inside, place), frame, off))
    return rows


def _jitter_row(
    pairs: Pairs,
    middle: tuple[Flags, Floats],
    frame: Frame,
    off: tuple[Floats, Floats] | None,
) -> Row:
    """Judge jitter: how much of what was drawn is found again, where nothing else makes delays."""
    inside, place = middle
    drawn = place[inside] - place[inside].mean()

    def slope(delay: Floats) -> tuple[float, float]:
        # Those that did not meet their drawn fate are others' doing: clipped, they move little.
        rest = (delay - pairs.drawn)[inside] / frame.jitter[inside]
        rest = np.clip(rest - np.nanmedian(rest), -1.0, 1.0)
        rest = np.where(np.isnan(rest), 0.0, rest)
        return 1.0 + float((rest * drawn).sum() / (drawn**2).sum()), float(rest.std())

    found, scatter = slope(pairs.heard)
    share = JITTER_SHARES[0]
    least, most = (1.0 - share, 1.0 + share) if off is None else (slope(one)[0] for one in off)
    spread = float(drawn.std())
    noise = Z_MISS * scatter / (spread * len(drawn) ** 0.5)
    asked = spread * frame.unit
    bounds = asked * (least + noise), asked * (most - noise)
    return _row("middle", "s", asked, found * asked, bounds)


def _loss_row(profile: DirectionProfile, pairs: Pairs) -> Row:
    """Judge losses by those that were not drawn, and drawn ones that did not happen."""
    lost, count = ~pairs.arrived, len(pairs.arrived)
    drawn = ~np.isfinite(pairs.drawn)
    asked, measured = float(drawn.mean()), float(lost.mean())
    wrong = int((lost != drawn).sum())
    most = _mismatches(profile, count, share_margin(asked))
    verdict: Verdict = "open" if most < 0 else "ok" if wrong <= most else "off"
    share = max(0, most) / count
    low, high = max(0.0, asked - share), asked + share
    return Row("loss", "1", asked, nan, measured, low, high, verdict)


def _mismatches(profile: DirectionProfile, count: int, margin: float) -> int:
    """Say how many fates may differ of those of a link whose loss is as asked; -1: too few tell.

    A link that is off by the margin has at least as many wrong fates, in bursts like its losses.
    """
    bursts = [
        loss
        for loss in (profile.loss, *(change.loss for change in profile.changes))
        if isinstance(loss, GilbertElliott) and loss.bad_start and loss.loss_bad > margin
    ]
    wrong: Loss = margin
    if bursts:
        longest = min(bursts, key=lambda one: one.bad_end)
        end, bad = longest.bad_end, margin / longest.loss_bad
        wrong = GilbertElliott(min(1.0, end * bad / (1.0 - bad)), end, longest.loss_bad)
    below = np.cumsum(chances([(count, wrong)]))
    return int(np.searchsorted(below, MISS, side="right")) - 1


def _reordered_row(pairs: Pairs) -> Row:
    def share(delay: Floats, lost: Flags) -> float:
        there = max(1, int((~lost).sum()))
        # To the microsecond: what was released at one instant has not overtaken.
        arrival = np.rint(np.where(lost, 0.0, pairs.sent + np.where(lost, 0.0, delay)) * 1e6)
        return float(overtaken(arrival, lost).sum()) / there

    lost, drawn = ~pairs.arrived, ~np.isfinite(pairs.drawn)
    count = int(pairs.arrived.sum())
    return _share_row("reordered", share(pairs.drawn, drawn), share(pairs.heard, lost), count)


def _share_row(name: str, asked: float, measured: float, count: int) -> Row:
    """Judge a share of what was compared one by one."""
    off = asked + share_margin(asked)
    margin = share_margin(asked) - Z_MISS * (off * max(0.0, 1.0 - off) / max(1, count)) ** 0.5
    return _row(name, "1", asked, measured, (max(0.0, asked - margin), asked + margin))


def _row(name: str, unit: str, asked: float, measured: float, allowed: tuple[float, float]) -> Row:
    low, high = allowed
    verdict: Verdict = "open" if low > high else "ok" if low <= measured <= high else "off"
    return Row(name, unit, asked, nan, measured, low, high, verdict)


COARSE, FINE = 0.01, 2e-3
"""Steps of the search [s]."""
EARLIER, LATER = 5.0, 0.2
"""It may have begun so long before or after what is looked at, the time line's length apart [s]."""
ORIGIN_SPAN_MAX = 300.0
"""Longest time line that is searched [s]."""
_REACH = 0.03
_TELLING = 1000
_LOST = 0.05
"""A loss where none should be, or none in a blackout, counts like so much delay [s]."""


def length(profile: DirectionProfile) -> float:
    """Say after which time conditions do not change any more [s]."""
    return Timeline(profile).starts_ns[-1] * 1e-9


def search(
    profile: DirectionProfile,
    sent: Floats,
    delay: Floats,
    breathe: Callable[[], None] = lambda: None,
) -> float:
    """Find roughly when a time line began, on the clock of `sent` [s].

    Args:
        profile: Whose time line.
        sent: When each datagram left, from the first [s], shape (n,).
        delay: Of each [s], shape (n,); NaN if it was lost.
        breathe: Called now and then.
    """
    timeline = Timeline(profile)
    starts = np.array(timeline.starts_ns) * 1e-9
    pieces = [timeline.at(start_ns) for start_ns in timeline.starts_ns]
    base = np.array([piece.delay_ns * 1e-9 for piece in pieces])
    dark = np.array([piece.blackout for piece in pieces])
    lost = ~np.isfinite(delay)
    here = np.where(lost, 0.0, delay)

    def cost(origin: float) -> float:
        index = np.maximum(np.searchsorted(starts, sent - origin, side="right") - 1, 0)
        wrong = np.where(lost == dark[index], np.abs(here - base[index]), _LOST)
        wrong[lost & dark[index]] = 0.0
        return float(np.minimum(wrong, _LOST).sum())

    best, least = 0.0, inf
    earliest = -(min(ORIGIN_SPAN_MAX, length(profile)) + EARLIER)
    for origin in np.arange(LATER, earliest, -COARSE).tolist():
        found = cost(origin)
        if found < least - 1e-9:  # of equals the latest
            best, least = origin, found
        breathe()
    return best


def around(coarse: float) -> list[float]:
    """Give what may be the beginning, near a coarse one [s]."""
    near: list[float] = np.arange(coarse - _REACH, coarse + _REACH, FINE).tolist()
    return [coarse, *near]


def near_changes(profile: DirectionProfile, elapsed: Floats) -> slice:
    """Choose a thousand datagrams, sent at `elapsed` [s], that tell most of where they are."""
    starts = np.array(Timeline(profile).starts_ns[1:]) * 1e-9
    inside = starts[(starts > elapsed[0]) & (starts < elapsed[-1])]
    if not len(inside):
        return slice(0, _TELLING)
    first = max(0, int(np.searchsorted(elapsed, inside[0])) - _TELLING // 4)
    return slice(first, first + _TELLING)


WINDOW = 128
"""So many datagrams later one that has not arrived is lost."""
SPAN_MAX = 30_000
"""Datagrams that are compared at most, those that did not arrive included: those of 5 min."""
NEAR = 3e-3
"""A datagram that arrives within so much of its drawn delay met its drawn fate [s]."""
SAME_SHARE = 0.5
"""If fewer of the datagrams do, the link draws otherwise, or is another one."""
_SURE = 0.99
"""If so many do, the beginning of the time line is known well enough."""
_SEARCHES_MAX = 8
_OFF = (1.0 - JITTER_SHARES[0], 1.0 + JITTER_SHARES[0])
_CHUNK = 256

Heard = tuple[int, int, float]
"""When a datagram arrived [ns], its counter, its delay [s]: NaN without a shared clock."""


class Stream(NamedTuple):
    """Whose draws they are: of the experiment, the direction, and what flies there."""

    seed: int
    uplink: bool
    kind: int
    size: int


@dataclass(frozen=True, slots=True)
class Compared:
    """What came of it.

    Attributes:
        rows: Of the quantities.
        same: Share of the datagrams that met their drawn fate, in [0, 1].
        pairs: That it comes of.
    """

    rows: list[Row]
    same: float
    pairs: Pairs

    @property
    def decided(self) -> bool:
        """Whether this proves that the link is what was asked for."""
        return self.same > SAME_SHARE and {row.verdict for row in self.rows} == {"ok"}


class Twin:
    """Draws what a link of a profile does to the datagrams that were heard."""

    def __init__(
        self, profile: DirectionProfile, stream: Stream, breathe: Callable[[], None] = lambda: None
    ) -> None:
        """Set up.

        Args:
            profile: What is asked.
            stream: Whose draws.
            breathe: Called every few hundred microseconds, so that others may run.
        """
        self._profile, self._stream, self._breathe = profile, stream, breathe
        self._changes = Timeline(profile).only() is None
        self._origin_ns: int | None = None  # on the receiver's clock
        self._searches = 0

    def compare(self, epoch: int, heard: Sequence[Heard]) -> Compared | None:
        """Compare what was heard, as it came; None if that is too little.

        Args:
            epoch: Of the session.
            heard: All of one session.
        """
        log = _in_order(heard)
        if log is None or (self._changes and not np.isfinite(log.delay).any()):
            return None
        if self._origin_ns is None:
            self._origin_ns = log.sent_ns[0] + self._find_origin(log, epoch)
        pairs = self._pairs(log, self._origin_ns, epoch)
        if self._changes and _same(pairs) < _SURE and self._searches < _SEARCHES_MAX:
            self._origin_ns = log.sent_ns[0] + self._find_origin(log, epoch)
            pairs = self._pairs(log, self._origin_ns, epoch)
        off = None
        if self._profile.keep_order and has_jitter(self._profile):
            less, more = (self._off(log, factor, epoch) for factor in _OFF)
            off = less, more
        return Compared(judged(self._profile, pairs, off), _same(pairs), pairs)

    def _off(self, log: _Log, factor: float, epoch: int) -> Floats:
        """Draw the delays of a link whose jitter is off by a factor [s]."""
        elapsed_ns = [at_ns - (self._origin_ns or 0) for at_ns in log.sent_ns]
        profile = scaled(self._profile, factor)
        return self._draw(log.counters, elapsed_ns, epoch, profile)[0]

    def _pairs(self, log: _Log, origin_ns: int, epoch: int) -> Pairs:
        """Draw what befalls what was sent on a time line that began at `origin_ns` [ns]."""
        elapsed_ns = [at_ns - origin_ns for at_ns in log.sent_ns]
        drawn, copies = self._draw(log.counters, elapsed_ns, epoch)
        sent = np.array(elapsed_ns) * 1e-9
        return Pairs(sent, log.delay, drawn, log.copies > 0, copies, log.copies)

    def _find_origin(self, log: _Log, epoch: int) -> int:
        """Say when the time line began, from the first datagram on [ns]: mostly before it."""
        if not self._changes:
            return 0
        self._searches += 1
        first_ns = log.sent_ns[0]
        sent = (np.array(log.sent_ns) - first_ns) * 1e-9
        coarse = search(self._profile, sent, log.delay, self._breathe)
        near = log.part(near_changes(self._profile, sent - coarse))

        def misfit(origin: float) -> float:
            return 1.0 - _same(self._pairs(near, first_ns + round(origin * 1e9), epoch))

        return round(min(around(coarse), key=misfit) * 1e9)

    def _draw(
        self,
        counters: range,
        elapsed_ns: list[int],
        epoch: int,
        profile: DirectionProfile | None = None,
    ) -> tuple[Floats, Floats]:
        """Draw delay [s] and copies of each datagram; NaN and 0 if it is lost."""
        seed, uplink, kind, size = self._stream
        link = LinkDirection(profile or self._profile, seed, uplink)
        whole, delays, copies = bytes(size), list[float](), list[int]()
        for place, (counter, at_ns) in enumerate(zip(counters, elapsed_ns, strict=True)):
            fate = link.send(epoch, kind, counter, size, at_ns)
            if fate and link.corrupts and link.corrupted(epoch, kind, counter, whole) != whole:
                fate = ()  # what is damaged is refused
            delays.append((min(fate) - at_ns) * 1e-9 if fate else nan)
            copies.append(len(fate))
            if place % _CHUNK == 0:
                self._breathe()
        return np.array(delays), np.array(copies, dtype=np.float64)


class _Log(NamedTuple):
    """Datagrams by their counters, those that did not arrive between them.

    Attributes:
        counters: All in a row.
        sent_ns: When each left [ns], receiver's clock; of those that were lost as if in step.
        delay: Of the first copy [s], shape (n,); NaN if it did not arrive, or is not known.
        copies: That arrived, shape (n,).
    """

    counters: range
    sent_ns: list[int]
    delay: Floats
    copies: Floats

    def part(self, cut: slice) -> _Log:
        """Take some in a row."""
        counters, sent_ns, delay, copies = self
        return _Log(counters[cut], sent_ns[cut], delay[cut], copies[cut])


def _in_order(heard: Sequence[Heard]) -> _Log | None:
    """Sort by counter what is final; None if that is too little."""
    newest = max((counter for _, counter, _ in heard), default=0)
    # What lies behind a gap of hours is compared with nothing: each that is missing costs memory.
    heard = [one for one in heard if newest - one[1] < SPAN_MAX]
    if len(heard) < FEWEST // 2:
        return None
    first, last = heard[0][1], newest - WINDOW
    count, begin_ns = last - first + 1, heard[0][0]
    if count < FEWEST:
        return None
    delay, after = np.full(count, nan), np.full(count, nan)
    copies = np.zeros(count)
    for stamp_ns, counter, one in heard:
        place = counter - first
        if 0 <= place < count:
            if not copies[place]:
                delay[place] = one
                after[place] = stamp_ns - begin_ns - (one * 1e9 if one == one else 0.0)
            copies[place] += 1
    known = np.flatnonzero(copies)
    after = np.interp(np.arange(count), known, after[known])
    sent_ns = [begin_ns + at_ns for at_ns in np.rint(after).astype(np.int64).tolist()]
    return _Log(range(first, last + 1), sent_ns, delay, copies)


def _same(pairs: Pairs) -> float:
    """Say which share met its drawn fate, in [0, 1]; without delays, which loss."""
    lost_both = ~np.isfinite(pairs.drawn) & ~pairs.arrived
    if not pairs.timed.any():
        return float((np.isfinite(pairs.drawn) == pairs.arrived).mean())
    with np.errstate(invalid="ignore"):
        near = np.abs(pairs.heard - pairs.drawn) < NEAR
    return float((near | lost_both).mean())
