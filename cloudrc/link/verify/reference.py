"""What probes ought to meet on a link: a profile and instants of sending go in, fates come out.

A second opinion: it shares the profile and its time line with the model, but none of the code that
draws. Whole runs are drawn at once with numpy's own generator, so that what is measured is judged
against what was asked, not against what our model made of it.

A number that probes measure: how it scatters on a true link, and when it is believed.

It is believed if a confidence interval around what was measured lies within its margin of what was
asked (a test of equivalence): one that is off by the margin passes with chance MISS.

Source: D. J. Schuirmann, "A comparison of the two one-sided tests procedure and the power
approach", J. Pharmacokin. Biopharm. 15, 1987.

Numbers of probes and how they scatter: fates of many batches come in, estimates go out.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from math import ceil, sqrt
from statistics import NormalDist
from typing import NamedTuple, TypeAlias

import numpy as np
from numpy.typing import NDArray

from cloudrc.link.profile import Conditions, DirectionProfile, GilbertElliott, Timeline, bad_share

Floats: TypeAlias = NDArray[np.float64]
Flags: TypeAlias = NDArray[np.bool_]

WIRE_BYTES = 28
"""IPv4 and UDP headers [bytes]. Source: RFC 791, RFC 768."""

_GRID: Floats = np.linspace(-7.0, 7.0, 14_001)
_PARETO_EXPONENT, _PARETO_CUT = 3.0, 1e-3


@dataclass(frozen=True, slots=True)
class NetemProfile(DirectionProfile):
    """A profile whose bottleneck is behind its delay, and keeps the order: netem's.

    What a slow packet has held up comes one by one then, as the wire lets it through.
    """


class Fates(NamedTuple):
    """What became of the probes of some runs, one row each.

    Attributes:
        arrived: Whether at least one copy did, shape (runs, n).
        delay: Of the first copy [s], shape (runs, n); 0 where none arrived.
        overtaken: Whether a probe sent later was there before it, shape (runs, n).
        doubled: Whether two copies arrived, shape (runs, n).
    """

    arrived: Flags
    delay: Floats
    overtaken: Flags
    doubled: Flags


def draw(
    profile: DirectionProfile, sent: Floats, size: int, runs: int, rng: np.random.Generator
) -> Fates:
    """Send the same probes over so many links of a profile.

    A queue that overflows is not simulated: do not offer more than the bottleneck passes.

    Args:
        profile: What is asked of the direction.
        sent: When each leaves, since the link came up, rising [s], shape (n,).
        size: Of each, UDP payload [bytes].
        runs: How many links.
        rng: Chance.
    """
    pieces = pieces_of(profile, sent)
    shape = (runs, len(sent))
    lost, extra = _losses(pieces, shape, rng)
    delay = np.maximum(0.0, _bases(pieces) + extra + _jitters(profile, pieces, shape, rng))
    overtakes = rng.random(shape) < profile.reorder
    behind = isinstance(profile, NetemProfile)
    queued = 0.0 if behind else _queue(pieces, sent, size, lost | overtakes)
    arrival = sent + np.where(overtakes, 0.0, queued + delay)
    arrival[lost] = -np.inf
    doubled = ~lost & (rng.random(shape) < profile.duplicate)
    copy = np.full(shape, -np.inf)
    if profile.duplicate:
        later = _bases(pieces) + extra * ~overtakes
        later = np.maximum(0.0, later + _jitters(profile, pieces, shape, rng, copies=True))
        copy = np.where(doubled, sent + queued + later, copy)
    if behind:
        arrival = np.where(lost, arrival, _one_by_one(arrival, copy, _wires(pieces, size)))
    elif profile.keep_order:
        arrival = np.where(lost, arrival, _in_order(arrival, copy))
    else:
        arrival = np.where(doubled, np.minimum(arrival, copy), arrival)
    late = overtaken(arrival, lost)
    return Fates(~lost, np.where(lost, 0.0, arrival - sent), late, doubled)


def _in_order(arrival: Floats, copy: Floats) -> Floats:
    """Let nothing arrive before what was sent before it; a copy is sent right after its original.

    Args:
        arrival: Of the originals [s], shape (runs, n); -infinity where there is none.
        copy: Of the copies [s], likewise.
    """
    both = np.stack((arrival, copy), axis=2).reshape(arrival.shape[0], -1)
    kept: Floats = np.maximum.accumulate(both, axis=1)[:, ::2]
    return kept


def _one_by_one(arrival: Floats, copy: Floats, wire: Floats) -> Floats:
    """Let all wait for the wire in the order of sending; a copy is sent right before its original.

    A recursion as in `_queue`, with instants of arrival at the wire in place of those of sending.

    Args:
        arrival: Of the originals at the wire [s], shape (runs, n); -infinity where there is none.
        copy: Of the copies [s], likewise.
        wire: What each takes [s], shape (n,).

    Returns:
        When the first of both is through [s], shape (runs, n).
    """
    both = np.stack((copy, arrival), axis=2).reshape(arrival.shape[0], -1)
    service = np.where(np.isfinite(both), np.repeat(wire, 2), 0.0)
    done = np.cumsum(service, axis=1)
    through = done + np.maximum.accumulate(both - done + service, axis=1)
    first: Floats = np.where(np.isfinite(copy), through[:, ::2], through[:, 1::2])
    return first


def instants(count: int, period: float, begin: float = 0.0) -> Floats:
    """When so many probes leave, one per `period` [s], the first at `begin` [s], shape (count,)."""
    return begin + np.arange(count, dtype=np.float64) * period


def overtaken(arrival: Floats, lost: Flags) -> Flags:
    """Tell which probes came after one that was sent later.

    Source: RFC 4737, section 3: a packet is reordered if it is older than the newest seen.

    Args:
        arrival: Of the first copy [s], in the order of sending, shape (..., n).
        lost: Whether none arrived, shape (..., n).
    """
    there = np.where(lost, np.inf, arrival)
    first_of_later = np.minimum.accumulate(there[..., ::-1], axis=-1)[..., ::-1]
    result = np.zeros(arrival.shape, dtype=np.bool_)
    result[..., :-1] = there[..., :-1] > first_of_later[..., 1:]
    return result & ~lost


def pieces_of(profile: DirectionProfile, sent: Floats) -> list[tuple[slice, Conditions]]:
    """Cut the probes into stretches in which the same conditions hold."""
    timeline = Timeline(profile)
    cuts = np.searchsorted(sent, np.array(timeline.starts_ns[1:]) * 1e-9).tolist()
    edges = [0, *cuts, len(sent)]
    return [
        (slice(start, stop), timeline.at(begin_ns))
        for start, stop, begin_ns in zip(edges, edges[1:], timeline.starts_ns, strict=False)
        if stop > start
    ]


def _bases(pieces: list[tuple[slice, Conditions]]) -> Floats:
    return np.concatenate(
        [np.full(part.stop - part.start, now.delay_ns * 1e-9) for part, now in pieces]
    )


def _losses(
    pieces: list[tuple[slice, Conditions]], shape: tuple[int, int], rng: np.random.Generator
) -> tuple[Flags, Floats]:
    """Draw who is lost, and what the bad state adds to the others' delay [s]."""
    lost, extra = np.zeros(shape, dtype=np.bool_), np.zeros(shape)
    draws = rng.random(shape)
    for part, now in pieces:
        if now.blackout:
            lost[:, part] = True
        elif isinstance(now.loss, GilbertElliott):
            bad = _bad(now.loss, (shape[0], part.stop - part.start), rng)
            lost[:, part] = draws[:, part] < np.where(bad, now.loss.loss_bad, now.loss.loss_good)
            extra[:, part] = bad * now.loss.delay_bad
        else:
            lost[:, part] = draws[:, part] < now.loss
    return lost, extra


def _bad(loss: GilbertElliott, shape: tuple[int, int], rng: np.random.Generator) -> Flags:
    """Run the two-state chain from its stationary distribution."""
    states = np.zeros(shape, dtype=np.bool_)
    if not loss.bad_start:
        return states
    draws = rng.random(shape)
    bad = draws[:, 0] < bad_share(loss)
    states[:, 0] = bad
    for n in range(1, shape[1]):
        bad = np.where(bad, draws[:, n] >= loss.bad_end, draws[:, n] < loss.bad_start)
        states[:, n] = bad
    return states


def _jitters(
    profile: DirectionProfile,
    pieces: list[tuple[slice, Conditions]],
    shape: tuple[int, int],
    rng: np.random.Generator,
    copies: bool = False,
) -> Floats:
    """Draw what jitter adds [s]."""
    scale = np.concatenate([np.full(part.stop - part.start, now.jitter) for part, now in pieces])
    if not scale.any():
        return np.zeros(shape)
    correlation = 0.0 if copies else profile.correlation
    normal = rng.standard_normal(shape)
    if correlation:
        fresh = sqrt(1.0 - correlation**2)
        for n in range(1, shape[1]):
            normal[:, n] = correlation * normal[:, n - 1] + fresh * normal[:, n]
    variates: Floats = normal if profile.distribution == "normal" else _shaped(profile, normal)
    return scale * variates


def _shaped(profile: DirectionProfile, normal: Floats) -> Floats:
    """Turn normal variates into those of a profile's distribution, ranks kept."""
    share = np.interp(normal, _GRID, _cdf())
    if profile.distribution == "uniform":
        return 2.0 * share - 1.0
    if profile.distribution == "table":
        table = np.array(profile.table)
        return table[np.minimum((share * len(table)).astype(np.int64), len(table) - 1)]
    low, power = _PARETO_CUT, -1.0 / _PARETO_EXPONENT
    survival = 1.0 - (1.0 - low) * share
    mean = _moment(power, low)
    return (survival**power - mean) / sqrt(_moment(2.0 * power, low) - mean**2)


@cache
def _cdf() -> Floats:
    """Normal distribution at `_GRID`; takes too long for those who only import this."""
    return np.array([NormalDist().cdf(z) for z in _GRID.tolist()])


def _moment(power: float, low: float) -> float:
    """Mean of s**power for s uniform in (low, 1)."""
    return float((1.0 - low ** (power + 1.0)) / ((power + 1.0) * (1.0 - low)))


def _queue(
    pieces: list[tuple[slice, Conditions]], sent: Floats, size: int, absent: Flags
) -> Floats | float:
    """Work out how long each waits at the bottleneck and on its wire [s].

    Lindley's recursion d_n = max(t_n, d_(n-1)) + s_n, which is C_n + max over j of t_j - C_(j-1)
    with C the sum of all s so far.
    """
    if all(now.rate is None for _, now in pieces):
        return 0.0
    service = np.where(absent, 0.0, _wires(pieces, size))
    done = np.cumsum(service, axis=1)
    waits: Floats = done + np.maximum.accumulate(sent - done + service, axis=1) - sent
    return np.where(absent, 0.0, waits)


def _wires(pieces: list[tuple[slice, Conditions]], size: int) -> Floats:
    """Say how long each takes at the bottleneck [s], shape (n,)."""
    bits = (size + WIRE_BYTES) * 8.0
    return np.concatenate(
        [
            np.full(part.stop - part.start, bits / now.rate if now.rate else 0.0)
            for part, now in pieces
        ]
    )


MISS = 1e-3
"""Chance that a quantity which is off by its margin is believed."""
ALARM = 2.5e-7
"""Chance that a true one is not, to each side: two directions with up to 8 quantities, each with
two sides, add up to 0.8e-5."""

Z_MISS = NormalDist().inv_cdf(1.0 - MISS)
"""Of a normal deviate."""
_Z_ALARM = NormalDist().inv_cdf(1.0 - ALARM)
_WIDER = 1.1
"""A link that is off by its margin scatters a little more than a true one."""


@dataclass(frozen=True, slots=True)
class Quantity:
    """What is expected of one measured number.

    Attributes:
        expected: On a true link [s] or [1].
        spread: Standard deviation of what n probes measure, times the root of n [s] or [1].
        skew: Skewness of what `batch` probes measure [1].
        batch: That number of probes.
        margin: How far off it may be [s] or [1].
        blur: What others than the link may add to it, to either side [s] or [1].
    """

    expected: float
    spread: float
    skew: float
    batch: int
    margin: float
    blur: float = 0.0

    def noise(self, count: int) -> float:
        """Say how far off a true link's value may seem to be with `count` probes."""
        skew = abs(self.skew) * (self.batch / count) ** 0.5
        return self.blur + self.spread / sqrt(count) * _quantile(skew)

    def slack(self, count: int) -> float:
        """Say by how much what `count` probes measure may deviate; negative: it proves nothing."""
        return self.margin - Z_MISS * _WIDER * self.spread / sqrt(count)

    def needs(self) -> int:
        """Count the probes after which a true link passes."""
        room = self.margin - self.blur
        if room <= 0.0:
            return 1 << 40
        count = ceil(((_Z_ALARM + _WIDER * Z_MISS) * self.spread / room) ** 2)
        count = max(64, count)
        while self.slack(count) < self.noise(count):
            count = ceil(count * 1.1)
        return count


def _quantile(skew: float) -> float:
    """Quantile at ALARM of what is nearly normal but has some skewness, >= 0 [1].

    Source: Pearson's type III by the approximation of E. B. Wilson and M. M. Hilferty, "The
    distribution of chi-square", PNAS 17, 1931.
    """
    if skew < 1e-3:
        return _Z_ALARM
    cube = max(0.0, 1.0 + skew * _Z_ALARM / 6.0 - skew**2 / 36.0) ** 3
    return 2.0 / skew * (cube - 1.0)


REACHES = {"uniform": (1.3, 1.3), "normal": (3.0, 3.0), "pareto": (1.0, 3.0), "table": (3.0, 3.0)}
"""How far below and above the delay asked for the middle reaches, in units of the jitter."""


@dataclass(frozen=True, slots=True)
class Frame:
    """The middle of the delays: those near the one that is asked for at that time.

    Rare bursts, packets that overtake and long tails make most of a standard deviation, and hide
    what jitter does. In the middle it is seen, in units of the jitter asked for at that time.

    Attributes:
        base: Delay asked for when each probe is sent [s], shape (n,).
        jitter: Likewise [s]; 0 has no middle.
        below: How far the middle reaches, in units of the jitter [1].
        above: Likewise.
    """

    base: Floats
    jitter: Floats
    below: float
    above: float

    @property
    def unit(self) -> float:
        """Jitter in the mean of those that have any [s]."""
        jitters = self.jitter[self.jitter > 0.0]
        return float(jitters.mean()) if len(jitters) else 0.0

    def look(self, delay: Floats, there: Flags) -> tuple[Flags, Floats]:
        """Say which delays [s], shape (..., n), are in the middle, and where in it [jitter]."""
        unit = np.where(self.jitter > 0.0, self.jitter, 1.0)
        place = (delay - self.base) / unit
        inside = there & (self.jitter > 0.0) & (place >= -self.below) & (place <= self.above)
        return inside, np.where(inside, place, 0.0)


def frame_of(profile: DirectionProfile, sent: Floats) -> Frame:
    """Make the frame of probes that leave at `sent` [s] since the link came up, shape (n,)."""
    timeline = Timeline(profile)
    starts = np.array(timeline.starts_ns) * 1e-9
    pieces = [timeline.at(start_ns) for start_ns in timeline.starts_ns]
    index = np.maximum(np.searchsorted(starts, sent, side="right") - 1, 0)
    base = np.array([piece.delay_ns * 1e-9 for piece in pieces])[index]
    jitter = np.array([piece.jitter for piece in pieces])[index]
    return Frame(base, jitter, *REACHES[profile.distribution])


@dataclass(frozen=True, slots=True)
class Estimate:
    """A number that probes measure [s] or [1]: its value, and what each probe adds to its error."""

    value: float
    influence: Floats

    def judged(self, margin: float) -> Quantity:
        """Describe its scatter from batch to batch, with the margin that it has [s] or [1]."""
        batches = self.influence.mean(axis=1)
        deviation = float(batches.std())
        skew = float(((batches - batches.mean()) ** 3).mean() / deviation**3) if deviation else 0.0
        count = self.influence.shape[1]
        return Quantity(self.value, deviation * count**0.5, skew, count, margin)


class Estimates(NamedTuple):
    """As in `Expectation`."""

    mean: Estimate
    deviation: Estimate
    variation: Estimate
    middle: Estimate
    reordered: Estimate


class Drawn:
    """Fates of many batches of probes."""

    def __init__(self, fates: Fates, frame: Frame) -> None:
        """Take fates, shape (runs, n), and the frame of the n probes."""
        self._there, self._late, self._frame = fates.arrived, fates.overtaken, frame
        self._delay: Floats = np.where(fates.arrived, fates.delay, 0.0)

    def over_time(self) -> Floats:
        """Mean delay of each probe [s]."""
        sums: Floats = self._delay.sum(axis=0)
        means: Floats = sums / np.maximum(self._there.sum(axis=0), 1)
        return means

    def estimates(self, over_time: Floats | None) -> Estimates:
        """Estimate all there is, deviations about `over_time` [s], shape (n,)."""
        there, delay = self._there, self._delay
        share, number = max(float(there.mean()), 1e-9), max(1, int(there.sum()))
        mean = float(delay.sum()) / number
        residual = np.where(there, delay - (mean if over_time is None else over_time), 0.0)
        order = float(self._late.sum()) / number
        return Estimates(
            Estimate(mean, residual / share),
            _deviation(residual, there, 1.0),
            self._variation(),
            self._middle(),
            Estimate(order, (self._late - order * there) / share),
        )

    def _variation(self) -> Estimate:
        pairs: NDArray[np.bool_] = self._there[:, 1:] & self._there[:, :-1]
        steps = np.where(pairs, np.abs(np.diff(self._delay, axis=1)), 0.0)
        mean = float(steps.sum()) / max(1, int(pairs.sum()))
        return Estimate(mean, (steps - mean * pairs) / max(float(pairs.mean()), 1e-9))

    def _middle(self) -> Estimate:
        inside, place = self._frame.look(self._delay, self._there)
        mean = float(place.sum()) / max(1, int(inside.sum()))
        return _deviation(np.where(inside, place - mean, 0.0), inside, self._frame.unit)


def _deviation(residual: Floats, there: Flags, unit: float) -> Estimate:
    """Estimate a standard deviation of residuals, shape (runs, n), in so many seconds [s]."""
    share, number = max(float(there.mean()), 1e-9), max(1, int(there.sum()))
    variance = float((residual**2).sum()) / number
    deviation = variance**0.5
    squares = np.where(there, residual**2 - variance, 0.0)
    influence: Floats = unit * squares / (2.0 * max(deviation, 1e-9) * share)
    return Estimate(unit * deviation, influence)
