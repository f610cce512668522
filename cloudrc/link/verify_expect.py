"""What probes of a true link measure, how that scatters, and how far off a link may be.

Margins are the shares below; what that means for a measured number says the reference, which draws
links that are off by them, too.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from cloudrc.link.profile import DirectionProfile
from cloudrc.link.timeline import Timeline
from cloudrc.link.verify_quantity import Quantity
from cloudrc.link.verify_reference import Fates, Flags, Floats, draw, instants

MEAN_FLOOR, MEAN_SHARE = 2e-3, 0.05
SHARE_FLOOR, SHARE_SHARE = 0.02, 0.25
NOT_JUDGED = 0.0
JITTER_SHARES, JITTER_SHARES_TAILED = (0.10, 0.25, 0.50, NOT_JUDGED), (0.25, 0.50, NOT_JUDGED)
"""By which share jitter may be off: uniform and normal, or of a long tail. The second and third are
for links that keep their order although jitter is larger than the time between packets: so few of
their delays are independent that less would take many minutes. Where something else makes nearly
all of the delays' scatter, as packets that overtake do, jitter cannot be told at all."""
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
            jitter of RFC 3550, of one-way delays. None where `deviation` judges the jitter.
        reordered: Share of those that arrived which were overtaken.
        over_time: Mean delay of each probe [s], shape (n,); None where it is the same for all.
    """

    mean: Quantity
    deviation: Quantity
    variation: Quantity | None
    reordered: Quantity
    over_time: Floats | None

    def needs(self) -> int:
        """Count the probes that decide every quantity."""
        judged = (self.mean, self.deviation, self.variation, self.reordered)
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
    return JITTER_SHARES_TAILED if _is_tailed(profile) else JITTER_SHARES


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
    true = _draw(profile, schedule, batches)
    over_time = None if is_steady(profile) else true.over_time()
    mean, deviation, variation, reordered = true.estimates(over_time)
    share = jitter_shares(profile)[0] if share is None else share
    strict = _shifts(profile, schedule, share, over_time, batches // 3)
    loose = DEVIATION_SHARE_TAILED if _is_tailed(profile) else DEVIATION_SHARE
    by_deviation = deviation.judged(strict[0])
    by_variation: Quantity | None = variation.judged(strict[1])
    if share == NOT_JUDGED:
        by_variation, by_deviation = None, deviation.judged(loose * deviation.value)
    elif by_variation is not None and by_variation.needs() < by_deviation.needs():
        by_deviation = deviation.judged(max(strict[0], loose * deviation.value))
    else:
        by_variation = None
    if deviation.value < 2.0 * DEVIATION_FLOOR:
        by_deviation = deviation.judged(max(by_deviation.margin, DEVIATION_FLOOR))
    return Expectation(
        mean.judged(max(MEAN_FLOOR, MEAN_SHARE * mean.value)),
        by_deviation,
        by_variation,
        reordered.judged(share_margin(reordered.value)),
        over_time,
    )


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
    delay = np.where(fates.arrived, fates.delay, 0.0)
    drawn = _Drawn(fates.arrived, delay, fates.overtaken)
    over_time = None if asked.over_time is None else drawn.over_time()
    mean, deviation, variation, reordered = drawn.estimates(over_time)
    return Expectation(
        replace(asked.mean, expected=mean.value),
        replace(asked.deviation, expected=deviation.value),
        asked.variation and replace(asked.variation, expected=variation.value),
        replace(asked.reordered, expected=reordered.value),
        over_time,
    )


def _shifts(
    profile: DirectionProfile,
    schedule: Schedule,
    share: float,
    over_time: Floats | None,
    batches: int,
) -> tuple[float, float]:
    """Say how far deviation and variation move, at least, if the jitter is off by a share."""
    jitters = [profile.jitter, *(change.jitter for change in profile.changes)]
    if share == NOT_JUDGED or not any(jitters):
        return 0.0, 0.0
    # A third of the batches: of the same chances in all three, differences hardly scatter.
    low, true, high = (
        _draw(_scaled(profile, factor), schedule, batches).estimates(over_time)
        for factor in (1.0 - share, 1.0, 1.0 + share)
    )
    deviation, variation = (
        min(abs(low[k].value - true[k].value), abs(high[k].value - true[k].value)) for k in (1, 2)
    )
    return deviation, variation


@dataclass(frozen=True, slots=True)
class _Estimate:
    """A number that probes measure: its value, and what each probe adds to its error."""

    value: float
    influence: Floats

    def judged(self, margin: float) -> Quantity:
        """Describe its scatter from batch to batch."""
        batches = self.influence.mean(axis=1)
        deviation = float(batches.std())
        skew = float(((batches - batches.mean()) ** 3).mean() / deviation**3) if deviation else 0.0
        count = self.influence.shape[1]
        return Quantity(self.value, deviation * count**0.5, skew, count, margin)


@dataclass(frozen=True, slots=True)
class _Drawn:
    """Fates of many batches of probes."""

    there: Flags
    delay: Floats
    late: Flags

    def over_time(self) -> Floats:
        """Mean delay of each probe [s]."""
        sums: Floats = self.delay.sum(axis=0)
        means: Floats = sums / np.maximum(self.there.sum(axis=0), 1)
        return means

    def estimates(
        self, over_time: Floats | None
    ) -> tuple[_Estimate, _Estimate, _Estimate, _Estimate]:
        """Mean, standard deviation, variation and share overtaken, about `over_time` [s]."""
        there, delay = self.there, self.delay
        share, number = max(float(there.mean()), 1e-9), max(1, int(there.sum()))
        mean = float(delay.sum()) / number
        residual = np.where(there, delay - (mean if over_time is None else over_time), 0.0)
        variance = float((residual**2).sum()) / number
        deviation = variance**0.5
        squares = np.where(there, residual**2 - variance, 0.0)
        order = float(self.late.sum()) / number
        return (
            _Estimate(mean, residual / share),
            _Estimate(deviation, squares / (2.0 * max(deviation, 1e-9) * share)),
            self._variation(),
            _Estimate(order, (self.late - order * there) / share),
        )

    def _variation(self) -> _Estimate:
        pairs: NDArray[np.bool_] = self.there[:, 1:] & self.there[:, :-1]
        steps = np.where(pairs, np.abs(np.diff(self.delay, axis=1)), 0.0)
        mean = float(steps.sum()) / max(1, int(pairs.sum()))
        return _Estimate(mean, (steps - mean * pairs) / max(float(pairs.mean()), 1e-9))


def _draw(profile: DirectionProfile, schedule: Schedule, batches: int) -> _Drawn:
    """Draw batches of one long flow, or the same story over and over if conditions change."""
    steady = is_steady(profile)
    if steady:
        skip, number, runs = _BURN_IN, _BURN_IN + _BATCH, batches
    else:
        skip, number = 0, schedule.count
        runs = max(8, min(batches // 6, _DRAWS_MAX // number))
    sent = instants(number, schedule.period, schedule.begin)
    fates: Fates = draw(profile, sent, schedule.size, runs, np.random.default_rng(_SEED))
    there = fates.arrived[:, skip:]
    return _Drawn(there, np.where(there, fates.delay[:, skip:], 0.0), fates.overtaken[:, skip:])


def _scaled(profile: DirectionProfile, factor: float) -> DirectionProfile:
    """Let the jitter be off by a factor, at all times."""
    changes = tuple(
        replace(change, jitter=None if change.jitter is None else factor * change.jitter)
        for change in profile.changes
    )
    return replace(profile, jitter=factor * profile.jitter, changes=changes)


def _is_tailed(profile: DirectionProfile) -> bool:
    return profile.distribution in ("pareto", "table")
