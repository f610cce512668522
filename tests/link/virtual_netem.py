"""The kernel's netem in virtual time, as `sch_netem.c` draws: what our own model does not share.

Source: Linux, net/sched/sch_netem.c: get_crandom, tabledist, loss_gilb_ell, netem_enqueue.
"""

from __future__ import annotations

import random

from cloudrc.errors import BadInputError
from cloudrc.link.profile import Conditions, DirectionProfile, GilbertElliott, Timeline
from cloudrc.link.tc import check, stretch, table

_WORDS, _ONE = 1 << 32, 8192
_HEADERS = 28
_IN_ORDER = 100e9


class VirtualNetem:
    """Shapes one direction; asked like the model's `LinkDirection`, in the order of sending."""

    def __init__(self, profile: DirectionProfile, seed: int) -> None:
        check(profile)
        self._profile, self._timeline = profile, Timeline(profile)
        self._chance = random.Random(seed)
        self._rho = round(profile.correlation * (_WORDS - 1))
        self._last_draw = self._chance.getrandbits(32)
        self._bad = False
        self._last_ns = 0
        distribution = profile.distribution
        self._table = None if distribution == "table" else table(distribution)

    def send(self, epoch: int, kind: int, counter: int, size: int, now_ns: int) -> list[int]:
        """Give the instants at which copies of a packet arrive [ns]."""
        now = self._timeline.at(now_ns)
        return [at_ns for at_ns in self._enqueue(now, size, now_ns, copies=True) if at_ns >= 0]

    def _enqueue(self, now: Conditions, size: int, now_ns: int, copies: bool) -> list[int]:
        profile, count, found = self._profile, 1, list[int]()
        if copies and self._chance.random() < profile.duplicate:
            count += 1
        if self._loses(now):
            count -= 1
        if count == 0:
            return []
        if count > 1:  # the copy goes through all of it once more
            found += self._enqueue(now, size, now_ns, copies=False)
        damaged = self._chance.random() < profile.corrupt
        if profile.reorder and not profile.keep_order and self._chance.random() < profile.reorder:
            return [*found, -1 if damaged else now_ns]
        at_ns = now_ns + self._delay_ns(now)
        rate = now.rate or (_IN_ORDER if profile.keep_order else None)
        if rate is not None:
            at_ns = max(at_ns, now_ns, self._last_ns) + round((size + _HEADERS) * 8e9 / rate)
            self._last_ns = at_ns
        return [*found, -1 if damaged else max(now_ns, at_ns)]

    def _loses(self, now: Conditions) -> bool:
        loss = 1.0 if now.blackout else now.loss
        if not isinstance(loss, GilbertElliott):
            return self._chance.random() < loss
        share = loss.loss_bad if self._bad else loss.loss_good
        if self._chance.random() < (loss.bad_end if self._bad else loss.bad_start):
            self._bad = not self._bad
        return self._chance.random() < share

    def _delay_ns(self, now: Conditions) -> int:
        if not now.jitter:
            return now.delay_ns
        drawn = self._draw()
        assert self._table is not None
        sigma = now.jitter * stretch(self._profile) * 1e9
        return round(now.delay_ns + sigma * self._table[drawn % len(self._table)] / _ONE)

    def _draw(self) -> int:
        """Draw a number whose first bits alone resemble those of the number before."""
        drawn = self._chance.getrandbits(32)
        if self._rho:
            rho = self._rho + 1
            drawn = (drawn * (_WORDS - rho) + self._last_draw * rho) >> 32
            self._last_draw = drawn
        return drawn


def can(profile: DirectionProfile) -> bool:
    """Whether netem can do it at all."""
    try:
        check(profile)
    except BadInputError:
        return False
    return True
