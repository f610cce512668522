"""How to probe a direction of a link: a profile goes in; rate, number and size of probes come out.

So many are sent that a true link passes with all its quantities but for a chance of 1e-5. Where
delays are independent that is a number of packets, and probes come faster than the tunnel's own to
be done soon; where they are not, the rate that is done first is taken.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import cache
from math import ceil
from typing import NamedTuple

from cloudrc.link.profile import DirectionProfile, Loss, mean_loss
from cloudrc.link.timeline import Timeline
from cloudrc.link.verify_expect import (
    JITTER_SHARES_TAILED,
    Expectation,
    Schedule,
    expect,
    is_steady,
    is_tailed,
    jitter_shares,
    share_margin,
)
from cloudrc.link.verify_loss import (
    Bounds,
    Stretch,
    believed,
    bounds,
    mean_of,
    shifted,
    spread,
    total,
)
from cloudrc.link.verify_quantity import ALARM, MISS
from cloudrc.link.verify_reference import WIRE_BYTES, instants, pieces_of

RATES = (100.0, 200.0, 500.0, 1000.0, 2000.0, 50.0, 20.0)
"""Probes per second that are tried, the tunnel's own first. Slower than that is for links that keep
their order although jitter is larger than the time between packets: then fewer tell more."""
SOON = 12.0
"""A rate that is done so soon [s] is not exceeded."""
LONGEST = 600.0
"""Longest time to probe [s]."""
LONG = 180.0
"""Likewise where what takes longer can be judged more loosely [s], which is then said."""
TELLABLE = 3600.0
"""Jitter that takes longer than this [s] to tell is not judged."""
HOST_LOSS = 1e-3
"""Share that a machine may lose of its own: a true link passes all the same."""
LINK_SHARE = 0.4
"""Share of a bottleneck's rate that probes may take."""

_SETTLE = 5.0
"""For how long a link that changes is watched after its last change [s]."""
_SHORTEST = 30.0
"""For how long at least [s]."""
_PROBES_MAX = 300_000
_FEWEST = 1000
_Z = 8.5
"""Normal deviates that lie between a true loss and one that is off by its margin, roughly."""


@dataclass(frozen=True, slots=True)
class Plan:
    """How to probe one direction.

    Attributes:
        profile: What is asked.
        schedule: Of the probes.
        expects: What they should measure.
        stretches: Packets under each loss, in order.
        needs: Probes after which every quantity is decided.
    """

    profile: DirectionProfile
    schedule: Schedule
    expects: Expectation
    stretches: tuple[Stretch, ...]
    needs: int

    @property
    def enough(self) -> bool:
        """Whether so many probes decide every quantity; if not, it takes more time."""
        return self.schedule.count >= self.needs

    @property
    def duration(self) -> float:
        """Time that it takes to send them [s]."""
        return self.schedule.period * self.schedule.count


def make_plan(
    profile: DirectionProfile, size: int, seconds: float | None = None, begin: float = 0.0
) -> Plan:
    """Choose rate and number of probes for one direction.

    Args:
        profile: What is asked.
        size: Of a probe, UDP payload [bytes].
        seconds: How long to probe [s]; None for as long as it takes, at most 600 s.
        begin: When the first leaves, since the link came up [s].
    """
    first, *looser = jitter_shares(profile)
    steady, tailed = is_steady(profile), is_tailed(profile)
    patience = LONGEST if steady and not tailed else LONG
    wish = _Wish(size, seconds, begin, first, patience)
    plan = _best(profile, wish)
    far = plan.needs * plan.schedule.period > TELLABLE
    if plan.enough or (steady and not tailed and not far):
        return plan
    if not steady and seconds is None:  # to watch how it ends for longer tells more
        longer = _best(profile, wish._replace(seconds=LONG))
        if longer.enough:
            return longer
    for share in looser if steady else JITTER_SHARES_TAILED[1:]:
        other = _best(profile, wish._replace(share=share))
        if other.enough:
            return other
    return plan


class _Wish(NamedTuple):
    """What does not depend on the rate: size [bytes], times [s], share of jitter.

    Attributes:
        size: Of a probe, UDP payload [bytes].
        seconds: How long to probe [s]; None for as long as it takes.
        begin: When the first leaves [s].
        share: By which the jitter may be off.
        longest: How long it may take at most [s].
    """

    size: int
    seconds: float | None
    begin: float
    share: float
    longest: float


def _best(profile: DirectionProfile, wish: _Wish) -> Plan:
    """Take the slowest rate that is done soon, else the one that is done first."""
    choices, seconds = [], wish.seconds
    for period in _periods(profile, wish.size):
        plan = _plan(profile, period, wish)
        choices.append(plan)
        if plan.enough and plan.duration <= (seconds or SOON):
            break
        if plan.enough and seconds is None and not is_steady(profile):
            break
    enough = [plan for plan in choices if plan.enough]
    if enough:
        return min(enough, key=lambda plan: plan.duration)
    return min(choices, key=lambda plan: plan.needs * plan.schedule.period)


def lost_of(profile: DirectionProfile, schedule: Schedule) -> float:
    """Say which share of probes a direction loses in the mean."""
    return mean_of(list(stretches_of(profile, schedule)))


def _plan(profile: DirectionProfile, period: float, wish: _Wish) -> Plan:
    """Plan for one rate."""
    seconds = wish.seconds
    if seconds is None and not is_steady(profile):
        seconds = max(_SHORTEST, _story(profile) - wish.begin)
    count = 0 if seconds is None else max(64, ceil(seconds / period))
    schedule = Schedule(period, count, wish.size, wish.begin)
    expects = expect(profile, schedule, wish.share)
    if seconds is None:
        count = min(needed(profile, expects), max(64, ceil(wish.longest / period)))
    schedule = replace(schedule, count=count)
    stretches = tuple(stretches_of(profile, schedule))
    lost = bounds(stretches, share_margin(mean_of(stretches)), MISS)
    copies: list[Stretch] = [(max(1, round(count - total(stretches))), profile.duplicate)]
    doubled = bounds(copies, share_margin(profile.duplicate), MISS)
    certain = 1.0 - 2.0 * ALARM
    enough = believed(stretches, lost) > certain and believed(copies, doubled) > certain
    needs = expects.needs()
    if not enough:
        needs = max(count + 1, needed(profile, expects))
    return Plan(profile, schedule, expects, stretches, needs)


def _periods(profile: DirectionProfile, size: int) -> list[float]:
    """Give the periods to try [s]: none fills a bottleneck by more than a share."""
    rates = [profile.rate, *(change.rate for change in profile.changes)]
    slowest = min((rate for rate in rates if rate), default=None)
    shortest = 0.0 if slowest is None else (size + WIRE_BYTES) * 8.0 / (LINK_SHARE * slowest)
    return [1.0 / rate for rate in RATES if 1.0 / rate >= shortest] or [shortest]


def _story(profile: DirectionProfile) -> float:
    """Say for how long a link that changes has to be watched [s]."""
    last = Timeline(profile).starts_ns[-1] * 1e-9
    return min(LONG, max(_SHORTEST, last + _SETTLE))


def needed(profile: DirectionProfile, expects: Expectation, most: int = _PROBES_MAX) -> int:
    """Count the probes that decide every quantity; of losses, no more than `most`."""
    arrive = max(0.01, 1.0 - mean_loss(profile.loss))
    marks = max(needed_losses(chance, most) for chance in (profile.duplicate, profile.corrupt))
    return max(expects.needs(), needed_losses(profile.loss, most), ceil(marks / arrive))


@cache
def needed_losses(loss: Loss, most: int) -> int:
    """Count the packets after which a true loss is believed; `most` if it takes that or more."""
    margin = share_margin(mean_loss(loss))
    count = max(_FEWEST, ceil((_Z * spread(loss) / margin) ** 2))
    while count < most:
        asked = [(count, loss)]
        if is_told(asked, bounds(asked, margin, MISS)):
            return count
        count = ceil(count * 1.1)
    return most


def is_told(asked: list[Stretch], allowed: Bounds) -> bool:
    """Say whether a true link is as good as certain to lose no more or less than is allowed."""
    host = [(packets, shifted(loss, HOST_LOSS)) for packets, loss in asked]
    return min(believed(asked, allowed), believed(host, allowed)) > 1.0 - 2.0 * ALARM


def stretches_of(profile: DirectionProfile, schedule: Schedule) -> Iterator[Stretch]:
    """Cut the probes into stretches of one loss."""
    sent = instants(schedule.count, schedule.period, schedule.begin)
    for part, now in pieces_of(profile, sent):
        yield part.stop - part.start, 1.0 if now.blackout else now.loss
