"""What probes of a true link measure, how that scatters, and how far off a link may be.

Margins are the shares below; what that means for a measured number says the reference, which draws
links that are off by them, too.

Damaged datagrams as losses: what is asked goes in, what an end sees that refuses them comes out.

The tunnel refuses a datagram whose tag does not fit, and the kernel one whose checksum does not.

What netem makes of a profile: what is asked goes in; what an honest netem does to it comes out.

netem draws a delay by the last bits of a number whose first bits alone resemble those of the number
before, so that of a correlation of jitter nothing is left, and a distribution keeps its width. It
loses either a packet or its copy, and sends the copy through its losses once more. Its bottleneck
is behind the delay, not before it.

Source: Linux, net/sched/sch_netem.c: get_crandom, tabledist, netem_enqueue.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, fields, replace

import numpy as np

from cloudrc.link.profile import (
    DirectionProfile,
    GilbertElliott,
    Loss,
    Timeline,
    bad_share,
    mean_loss,
)
from cloudrc.link.verify.reference import (
    Drawn,
    Estimates,
    Fates,
    Floats,
    Frame,
    NetemProfile,
    Quantity,
    draw,
    frame_of,
    instants,
)

MEAN_FLOOR, MEAN_SHARE = 2e-3, 0.05
SHARE_FLOOR, SHARE_SHARE = 0.02, 0.25
NOT_JUDGED = 0.0
JITTER_SHARES, JITTER_SHARES_TAILED = (0.10, NOT_JUDGED), (0.10, 0.25, 0.50, NOT_JUDGED)
"""By which share jitter may be off: uniform and normal, or of a long tail. What is looser than the
first is said with the verdict. Of uniform and normal the second is for links whose jitter an hour
of probes could not tell."""
DEVIATION_SHARE, DEVIATION_SHARE_TAILED = 0.25, 0.50
"""By which share a standard deviation may be off that is not what jitter is judged by: rare bursts
and long tails make it, or delays that resemble those before, and 10 % would take hours."""
DEVIATION_FLOOR = 5e-4
"""Machines, not links, make as much [s]."""

BATCHES = 768
"""Of probes that are drawn, where nobody waits."""
_BATCH, _BURN_IN = 768, 256
_DRAWS_MAX = 1_000_000
_SEED = 20250520


@dataclass(frozen=True, slots=True)
class Expectation:
    """What one direction's probes are expected to measure.

    Attributes:
        mean: Of the delays [s].
        deviation: Standard deviation of the delays, about their mean or, where that changes, about
            what it is at that time [s].
        variation: Mean absolute difference of the delays of two probes sent in a row [s]: the
            jitter of RFC 3550, of one-way delays. None where another quantity judges the jitter.
        middle: Standard deviation of the delays near the one asked for [s], as `Frame` has it:
            what overtakes, or waits in a burst, is no part of it. None likewise.
        reordered: Share of those that arrived which were overtaken.
        over_time: Mean delay of each probe [s], shape (n,); None where it is the same for all.
        share: By which the jitter may be off, in [0, 1]; 0 if it is not judged.
    """

    mean: Quantity
    deviation: Quantity
    variation: Quantity | None
    middle: Quantity | None
    reordered: Quantity
    over_time: Floats | None
    share: float

    def needs(self) -> int:
        """Count the probes that decide every quantity."""
        judged = (self.mean, self.deviation, self.variation, self.middle, self.reordered)
        return max(one.needs() for one in judged if one is not None)


def share_margin(asked: float) -> float:
    """Say how far off a share `asked` for, in [0, 1], may be."""
    return max(SHARE_FLOOR, SHARE_SHARE * asked)


def is_steady(profile: DirectionProfile) -> bool:
    """Say whether conditions never change."""
    only = Timeline(profile).only()
    return only is not None and not only.blackout


def jitter_shares(profile: DirectionProfile) -> tuple[float, ...]:
    """Say by which share the jitter may be off, strictest first."""
    return JITTER_SHARES_TAILED if is_tailed(profile) else JITTER_SHARES


@dataclass(frozen=True, slots=True)
class Schedule:
    """When probes leave, and how large they are.

    Attributes:
        period: From one to the next [s].
        count: How many; a link that never changes is the same for any number.
        size: Of each, UDP payload [bytes].
        begin: When the first leaves, since the link came up [s].
    """

    period: float
    count: int
    size: int
    begin: float = 0.0


def expect(
    profile: DirectionProfile,
    schedule: Schedule,
    share: float | None = None,
    batches: int = BATCHES,
) -> Expectation:
    """Work out what probes measure on a true link.

    Args:
        profile: What is asked.
        schedule: Of the probes.
        share: By which the jitter may be off, in [0, 1]; None for the strictest.
        batches: How many to draw of a steady link: fewer are quick, and know scatter less well.
    """
    true = draw_batches(profile, schedule, batches)
    over_time = None if is_steady(profile) else true.over_time()
    found = true.estimates(over_time)
    share = jitter_shares(profile)[0] if share is None else share
    by_deviation, by_variation, by_middle = _by_jitter(
        found, _shifts(profile, schedule, share, over_time, batches // 3)
    )
    loose = DEVIATION_SHARE_TAILED if is_tailed(profile) else DEVIATION_SHARE
    if by_deviation is None:
        by_deviation = found.deviation.judged(loose * found.deviation.value)
    if found.deviation.value < 2.0 * DEVIATION_FLOOR:
        by_deviation = replace(by_deviation, margin=max(by_deviation.margin, DEVIATION_FLOOR))
    return Expectation(
        found.mean.judged(max(MEAN_FLOOR, MEAN_SHARE * found.mean.value)),
        by_deviation,
        by_variation,
        by_middle,
        found.reordered.judged(share_margin(found.reordered.value)),
        over_time,
        share if has_jitter(profile) else NOT_JUDGED,
    )


def has_jitter(profile: DirectionProfile) -> bool:
    """Say whether there is any jitter, at any time."""
    return any((profile.jitter, *(change.jitter for change in profile.changes)))


_Choice = tuple[Quantity | None, Quantity | None, Quantity | None]


def _by_jitter(found: Estimates, shifts: tuple[float, float, float] | None) -> _Choice:
    """Choose which of deviation, variation and middle judges the jitter: that which needs least.

    Args:
        found: On a true link.
        shifts: How far each moves if the jitter is off; None if it is not judged.
    """
    if shifts is None:
        return None, None, None
    deviation, variation, middle = shifts
    quantities = [
        found.deviation.judged(deviation),
        found.variation.judged(variation),
        found.middle.judged(middle),
    ]
    best = min(range(3), key=lambda k: quantities[k].needs())
    first, second, third = (one if k == best else None for k, one in enumerate(quantities))
    return first, second, third


def as_sent(asked: Expectation, profile: DirectionProfile, sent: Floats, size: int) -> Expectation:
    """Expect of probes that left when they did, not when they should have.

    A sender that was held up sends a bunch at once, of which more overtake each other: that is not
    the link's doing. Scatter and margins stay as they were planned.

    Args:
        asked: As planned.
        profile: What is asked.
        sent: When each left, since the link came up [s], shape (n,).
        size: Of each, UDP payload [bytes].
    """
    runs = max(8, min(BATCHES // 6, _DRAWS_MAX // len(sent)))
    fates = draw(profile, sent, size, runs, np.random.default_rng(_SEED))
    drawn = Drawn(fates, frame_of(profile, sent))
    over_time = None if asked.over_time is None else drawn.over_time()
    found = drawn.estimates(over_time)
    return replace(
        asked,
        mean=replace(asked.mean, expected=found.mean.value),
        deviation=replace(asked.deviation, expected=found.deviation.value),
        variation=asked.variation and replace(asked.variation, expected=found.variation.value),
        middle=asked.middle and replace(asked.middle, expected=found.middle.value),
        reordered=replace(asked.reordered, expected=found.reordered.value),
        over_time=over_time,
    )


def _shifts(
    profile: DirectionProfile,
    schedule: Schedule,
    share: float,
    over_time: Floats | None,
    batches: int,
) -> tuple[float, float, float] | None:
    """Say how far deviation, variation and middle move if the jitter is off by a share."""
    if share == NOT_JUDGED or not has_jitter(profile):
        return None
    # A third of the batches: of the same chances in all three, differences hardly scatter.
    frame = _frame(profile, schedule)
    low, true, high = (
        draw_batches(scaled(profile, factor), schedule, batches, frame).estimates(over_time)
        for factor in (1.0 - share, 1.0, 1.0 + share)
    )

    def shift(name: str) -> float:
        less, same, more = (getattr(one, name).value for one in (low, true, high))
        return float(min(abs(less - same), abs(more - same)))

    return shift("deviation"), shift("variation"), shift("middle")


def _frame(profile: DirectionProfile, schedule: Schedule) -> Frame:
    number = _BATCH if is_steady(profile) else schedule.count
    return frame_of(profile, instants(number, schedule.period, schedule.begin))


def draw_batches(
    profile: DirectionProfile, schedule: Schedule, batches: int, frame: Frame | None = None
) -> Drawn:
    """Draw batches of one long flow, or the same story over and over if conditions change."""
    steady = is_steady(profile)
    if steady:
        skip, number, runs = _BURN_IN, _BURN_IN + _BATCH, batches
    else:
        skip, number = 0, schedule.count
        runs = max(8, min(batches // 6, _DRAWS_MAX // number))
    sent = instants(number, schedule.period, schedule.begin)
    fates: Fates = draw(profile, sent, schedule.size, runs, np.random.default_rng(_SEED))
    arrived, delay, overtaken, doubled = fates
    kept = Fates(arrived[:, skip:], delay[:, skip:], overtaken[:, skip:], doubled[:, skip:])
    return Drawn(kept, frame or _frame(profile, schedule))


def scaled(profile: DirectionProfile, factor: float) -> DirectionProfile:
    """Let the jitter be off by a factor [1], at all times."""
    changes = tuple(
        replace(change, jitter=None if change.jitter is None else factor * change.jitter)
        for change in profile.changes
    )
    return replace(profile, jitter=factor * profile.jitter, changes=changes)


def is_tailed(profile: DirectionProfile) -> bool:
    """Say whether jitter has a long tail."""
    return profile.distribution in ("pareto", "table")


def refusing(profile: DirectionProfile) -> DirectionProfile:
    """Give the profile that an end meets which refuses what is damaged: nothing is, more is lost.

    Args:
        profile: Its `corrupt` flips a bit in that share of the datagrams, all copies alike.
    """
    whole = 1.0 - profile.corrupt
    if whole == 1.0:
        return profile

    def joined(loss: Loss) -> Loss:
        if isinstance(loss, GilbertElliott):
            bad, good = (1.0 - (1.0 - one) * whole for one in (loss.loss_bad, loss.loss_good))
            return replace(loss, loss_bad=bad, loss_good=good)
        return 1.0 - (1.0 - loss) * whole

    return replace(each_loss(profile, joined), corrupt=0.0)


def each_loss(profile: DirectionProfile, made: Callable[[Loss], Loss]) -> DirectionProfile:
    """Put another loss in place of each that a profile asks for, at any time."""
    changes = tuple(
        replace(change, loss=None if change.loss is None else made(change.loss))
        for change in profile.changes
    )
    trace = profile.trace
    if trace is not None and trace.losses is not None:
        trace = replace(trace, losses=tuple(mean_loss(made(loss)) for loss in trace.losses))
    return replace(profile, loss=made(profile.loss), changes=changes, trace=trace)


def netem_makes(profile: DirectionProfile) -> DirectionProfile:
    """Give the profile that an end meets behind netem, in the reference's terms.

    Args:
        profile: What is asked of netem. A frame that it damages is dropped by its checksum.
    """
    made = replace(profile, correlation=0.0)
    rates = [profile.rate, *(change.rate for change in profile.changes)]
    if any(rates) and has_jitter(profile):
        made = NetemProfile(**{one.name: getattr(made, one.name) for one in fields(made)})
    if not profile.duplicate:
        return refusing(made)
    chance, damage = profile.duplicate, profile.corrupt

    def kept(loss: Loss) -> Loss:
        return _kept(loss, chance, damage)

    # Copies have no time line: they are those of the loss that it begins with.
    copies = _copied(profile.loss, chance, damage)
    return replace(each_loss(made, kept), duplicate=copies, corrupt=0.0)


def _kept(loss: Loss, chance: float, damage: float) -> Loss:
    """Say which packets are lost if each had a copy with this chance: those of which none is left.

    Args:
        loss: Of one packet.
        chance: Of a copy, in [0, 1].
        damage: Chance that one packet is damaged, in [0, 1].
    """

    def share(lost: float) -> float:
        alone = 1.0 - (1.0 - lost) * (1.0 - damage)
        # Lost beside a copy: that one stays, whole or not. Else either may fail by itself.
        return (1.0 - chance) * alone + chance * damage * (lost + (1.0 - lost) * alone)

    if not isinstance(loss, GilbertElliott):
        return share(loss)
    start, end = loss.bad_start, loss.bad_end
    # A copy that is made takes another step of the chain.
    bad, good = (chance * (1.0 - one) for one in (loss.loss_bad, loss.loss_good))
    return replace(
        loss,
        bad_start=start * (1.0 + good * (1.0 - start - end)),
        bad_end=end * (1.0 + bad * (1.0 - start - end)),
        loss_bad=share(loss.loss_bad),
        loss_good=share(loss.loss_good),
    )


def _copied(loss: Loss, chance: float, damage: float) -> float:
    """Say which share of those that arrive do so twice, in [0, 1]; arguments as of `_kept`."""
    if not isinstance(loss, GilbertElliott):
        loss = GilbertElliott(0.0, 1.0, loss, loss)  # never bad
    kept = _kept(loss, chance, damage)
    assert isinstance(kept, GilbertElliott)
    bad, start, end = bad_share(kept), loss.bad_start, loss.bad_end
    passes_bad, passes_good = 1.0 - loss.loss_bad, 1.0 - loss.loss_good
    after_bad = (1.0 - end) * passes_bad + end * passes_good
    after_good = (1.0 - start) * passes_good + start * passes_bad
    twice = bad * passes_bad * after_bad + (1.0 - bad) * passes_good * after_good
    there = 1.0 - bad * kept.loss_bad - (1.0 - bad) * kept.loss_good
    return chance * twice * (1.0 - damage) ** 2 / there if there > 0.0 else 0.0
