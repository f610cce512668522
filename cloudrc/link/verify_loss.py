"""How many of n probes a link may lose: exact chances of every count, bursts included.

Losses come in bursts, so that their number scatters far more than a binomial one: a true link with
6 % loss in bursts loses 4 % or 8 % of a few thousand packets. The chance of each count follows from
the generating function of the two-state chain, a product of 2x2 matrices, at the roots of unity.
"""

from __future__ import annotations

from collections.abc import Sequence
from math import sqrt
from typing import NamedTuple, TypeAlias

import numpy as np
from numpy.typing import NDArray

from cloudrc.link.profile import GilbertElliott, Loss, bad_share, mean_loss

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
