"""The link's own draws beside what was heard: datagrams of a flight come in, rows go out.

Chance depends on seed, direction, epoch and counter alone, so whoever knows these knows what befell
datagram n. What the drawn fates leave over is hardly any scatter: a few thousand datagrams prove
rare bursts, long tails and time lines which statistics would take many minutes for. Only the relay
draws so; of netem nothing fits, which is no fault: then the statistics decide.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from math import nan
from typing import NamedTuple

import numpy as np

from cloudrc.link.model import LinkDirection
from cloudrc.link.profile import DirectionProfile
from cloudrc.link.timeline import Timeline
from cloudrc.link.verify_expect import JITTER_SHARES, has_jitter, scaled
from cloudrc.link.verify_judge import Row
from cloudrc.link.verify_origin import around, near_changes, search
from cloudrc.link.verify_reference import Floats
from cloudrc.link.verify_twin_rows import FEWEST, Pairs, judged

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
