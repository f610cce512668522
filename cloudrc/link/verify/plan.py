"""How to probe a direction of a link: a profile goes in; rate, number and size of probes come out.

So many are sent that a true link passes with all its quantities but for a chance of 1e-5. Where
delays are independent that is a number of packets, and probes come faster than the tunnel's own to
be done soon; where they are not, the rate that is done first is taken.

How many of n probes a link may lose: exact chances of every count, bursts included.

Losses come in bursts, so that their number scatters far more than a binomial one: a true link with
6 % loss in bursts loses 4 % or 8 % of a few thousand packets. The chance of each count follows from
the generating function of the two-state chain, a product of 2x2 matrices, at the roots of unity.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cache
from math import ceil, sqrt
from typing import NamedTuple, TypeAlias

import numpy as np
from numpy.typing import NDArray

from cloudrc.link.profile import (
    DirectionProfile,
    GilbertElliott,
    Loss,
    Timeline,
    bad_share,
    mean_loss,
)
from cloudrc.link.verify.expect import (
    JITTER_SHARES_TAILED,
    Expectation,
    Schedule,
    expect,
    is_steady,
    is_tailed,
    jitter_shares,
    share_margin,
)
from cloudrc.link.verify.reference import ALARM, MISS, WIRE_BYTES, instants, pieces_of

Stretch: TypeAlias = tuple[int, Loss]
"""So many packets under one loss; a blackout is a loss of 1."""
_Complex: TypeAlias = NDArray[np.complex128]


class Bounds(NamedTuple):
    """Counts that are believed: from `low` to `high`, both included; empty if low > high."""

    low: int
    high: int


def chances(stretches: Sequence[Stretch]) -> NDArray[np.float64]:
    """Give the chance of losing k = 0, 1, ... n packets of those of some stretches.

    Exact to about 1e-12; a chain begins each stretch in its stationary state.
    """
    count = sum(packets for packets, _ in stretches)
    length = _smooth(count + 1)
    roots = np.exp(-2j * np.pi * np.arange(length) / length)
    product = np.ones(length, dtype=np.complex128)
    for packets, loss in stretches:
        product *= _generating(packets, loss, roots)
    return np.clip(np.fft.ifft(product).real[: count + 1], 0.0, 1.0)


def _smooth(least: int) -> int:
    """Give a number >= `least` that has no prime factor above 5: a transform of it is fast."""
    number = least
    while True:
        rest = number
        for factor in (2, 3, 5):
            while rest % factor == 0:
                rest //= factor
        if rest == 1:
            return number
        number += 1


def bounds(asked: Sequence[Stretch], margin: float, miss: float) -> Bounds:
    """Say which counts prove that the loss is within a margin of what was asked.

    Args:
        asked: Packets sent and the loss asked for.
        margin: How far off a share may be, in [0, 1].
        miss: Chance that a link which is off by the margin is believed all the same, in [0, 1].
    """
    count = sum(packets for packets, _ in asked)
    below = [(packets, shifted(loss, -margin)) for packets, loss in asked]
    above = [(packets, shifted(loss, margin)) for packets, loss in asked]
    low, high = 0, count
    if total(below) > 0.0:
        upper_tail = np.cumsum(chances(below)[::-1])[::-1]  # of k or more
        low = int(np.argmax(upper_tail <= miss)) if upper_tail[-1] <= miss else count + 1
    if total(above) < count:
        lower_tail = np.cumsum(chances(above))  # of k or fewer
        high = int(np.searchsorted(lower_tail, miss, side="right")) - 1
    return Bounds(0 if mean_of(asked) <= margin else low, high)


def plausible(asked: Sequence[Stretch], margin: float, alarm: float) -> Bounds:
    """Say which counts do not prove that the loss is off by more than a margin.

    Args:
        asked: Packets sent and the loss asked for.
        margin: How far off a share may be, in [0, 1].
        alarm: Chance that a link which is just within its margin shows another count, in [0, 1].
    """
    below = [(packets, shifted(loss, -margin)) for packets, loss in asked]
    above = [(packets, shifted(loss, margin)) for packets, loss in asked]
    low = int(np.searchsorted(np.cumsum(chances(below)), alarm, side="right"))
    upper_tail = np.cumsum(chances(above)[::-1])
    high = len(upper_tail) - 1 - int(np.searchsorted(upper_tail, alarm, side="right"))
    return Bounds(low, high)


def believed(asked: Sequence[Stretch], allowed: Bounds) -> float:
    """Give the chance that a true link is believed, in [0, 1]."""
    return float(chances(asked)[max(allowed.low, 0) : allowed.high + 1].sum())


def total(stretches: Sequence[Stretch]) -> float:
    """Give the mean number of packets lost."""
    return sum(packets * mean_loss(loss) for packets, loss in stretches)


def mean_of(stretches: Sequence[Stretch]) -> float:
    """Give the mean share of packets lost, in [0, 1]."""
    return total(stretches) / max(1, sum(packets for packets, _ in stretches))


def spread(loss: Loss) -> float:
    """Give the standard deviation of the number lost of n packets, over the root of n."""
    mean = mean_loss(loss)
    variance = mean * (1.0 - mean)
    if isinstance(loss, GilbertElliott) and loss.bad_start:
        bad, memory = bad_share(loss), 1.0 - loss.bad_start - loss.bad_end
        contrast = (loss.loss_bad - loss.loss_good) ** 2 * bad * (1.0 - bad)
        variance += 2.0 * contrast * memory / (1.0 - memory)
    return sqrt(max(variance, 0.0))


def shifted(loss: Loss, by: float) -> Loss:
    """Let a loss be off `by` so much [1]: bursts come more or less often, of equal length."""
    mean = min(1.0, max(0.0, mean_loss(loss) + by))
    if not isinstance(loss, GilbertElliott) or mean in (0.0, 1.0):
        return mean
    contrast = loss.loss_bad - loss.loss_good
    bad = (mean - loss.loss_good) / contrast if contrast else 0.0
    start = bad * loss.bad_end / (1.0 - bad) if bad < 1.0 else 1.0
    if not 0.0 < bad < 1.0 or start > 1.0:
        return mean
    return GilbertElliott(start, loss.bad_end, loss.loss_bad, loss.loss_good)


def _generating(packets: int, loss: Loss, z: _Complex) -> _Complex:
    """Mean of z**(packets lost), at each z."""
    if not isinstance(loss, GilbertElliott) or not loss.bad_start:
        mean = mean_loss(loss)
        return np.asarray((1.0 - mean + mean * z) ** packets, dtype=np.complex128)
    start, end, bad = loss.bad_start, loss.bad_end, bad_share(loss)
    good_factor = 1.0 - loss.loss_good + loss.loss_good * z
    bad_factor = 1.0 - loss.loss_bad + loss.loss_bad * z
    # Row: state before; column: state after, times what the packet that meets it contributes.
    step = (
        ((1.0 - start) * good_factor, start * bad_factor),
        (end * good_factor, (1.0 - end) * bad_factor),
    )
    row = ((1.0 - bad) * good_factor, bad * bad_factor)
    power = packets - 1
    while power > 0:
        if power & 1:
            row = _times(row, step)
        step = (_times(step[0], step), _times(step[1], step))
        power >>= 1
    return row[0] + row[1]


_Row: TypeAlias = tuple[_Complex, _Complex]


def _times(row: _Row, matrix: tuple[_Row, _Row]) -> _Row:
    """Multiply a row with a 2x2 matrix, at every root at once."""
    return (
        row[0] * matrix[0][0] + row[1] * matrix[1][0],
        row[0] * matrix[0][1] + row[1] * matrix[1][1],
    )


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
