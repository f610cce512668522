"""Numbers of probes and how they scatter: fates of many batches come in, estimates go out."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from cloudrc.link.profile import DirectionProfile
from cloudrc.link.timeline import Timeline
from cloudrc.link.verify_quantity import Quantity
from cloudrc.link.verify_reference import Fates, Flags, Floats

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
