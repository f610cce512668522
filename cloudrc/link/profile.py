"""What a link is asked to be: the conditions of both directions, in SI, as plain frozen data.

They mirror `config/schema.py`, which reads files and speaks milliseconds; `assembly.py` converts.
All delays are ONE WAY. Values are taken as checked: `config` and `link/trace.py` do that.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, TypeAlias


@dataclass(frozen=True, slots=True)
class GilbertElliott:
    """Loss in bursts: a two-state Markov chain that moves on with every packet.

    Source: E. N. Gilbert, Bell Syst. Tech. J. 39, 1960; E. O. Elliott, ibid. 42, 1963. In the terms
    of tc-netem's `gemodel`: p = bad_start, r = bad_end, 1-h = loss_bad, 1-k = loss_good.

    Attributes:
        bad_start: Chance per packet to go from the good to the bad state, in [0, 1].
        bad_end: Chance per packet to go from the bad to the good state, in [0, 1].
        loss_bad: Loss in the bad state, in [0, 1].
        loss_good: Loss in the good state, in [0, 1].
        delay_bad: Extra delay in the bad state, one way [s].
    """

    bad_start: float
    bad_end: float
    loss_bad: float = 1.0
    loss_good: float = 0.0
    delay_bad: float = 0.0


Loss: TypeAlias = float | GilbertElliott
"""Chance of an independent loss in [0, 1], or loss in bursts."""


def bad_share(loss: GilbertElliott) -> float:
    """Say which share of packets meets the bad state, in [0, 1]."""
    return loss.bad_start / (loss.bad_start + loss.bad_end) if loss.bad_start else 0.0


def mean_loss(loss: Loss) -> float:
    """Say which share of packets is lost in the long run, in [0, 1]."""
    if not isinstance(loss, GilbertElliott):
        return loss
    share = bad_share(loss)
    return share * loss.loss_bad + (1.0 - share) * loss.loss_good


@dataclass(frozen=True, slots=True)
class Change:
    """From `at` on these values hold; None leaves a value as it is.

    Attributes:
        at: Since the link came up [s].
        delay: One way [s].
        jitter: [s], as in `DirectionProfile`.
        loss: Chance, or bursts.
        rate: Of the bottleneck [bit/s].
    """

    at: float
    delay: float | None = None
    jitter: float | None = None
    loss: Loss | None = None
    rate: float | None = None


@dataclass(frozen=True, slots=True)
class Blackout:
    """A time in which nothing that is sent passes.

    Attributes:
        start: Since the link came up [s].
        duration: [s].
    """

    start: float
    duration: float


@dataclass(frozen=True, slots=True)
class Trace:
    """Measured conditions over time: each row holds until the next, the last one for ever.

    A trace stands in place of `delay`, and of `loss` if it has any; jitter comes on top of it.

    Attributes:
        times: Since the link came up, strictly rising [s], shape (n,), n >= 1. The first row also
            holds before its time.
        delays: One way [s], shape (n,).
        losses: In [0, 1], shape (n,), or None.
    """

    times: tuple[float, ...]
    delays: tuple[float, ...]
    losses: tuple[float, ...] | None = None


@dataclass(frozen=True, slots=True)
class DirectionProfile:
    """Conditions of one direction.

    Attributes:
        delay: One way [s].
        jitter: uniform: half width; normal, pareto, table: standard deviation [s]. The mean stays
            `delay`, except that a delay below 0 becomes 0.
        distribution: Of the delay about its mean.
        table: With `distribution` table: values that are drawn with equal chance, mean 0, standard
            deviation 1, rising, shape (n,) [1]; else ().
        correlation: Of the jitter of one packet with the next, in [0, 1].
        loss: Chance, or bursts.
        duplicate: Chance in [0, 1] that a packet arrives twice; the copy draws a delay of its own.
        reorder: Chance in [0, 1] that a packet overtakes: neither queue nor delay.
        corrupt: Chance in [0, 1] that one bit of the datagram is flipped, in all its copies.
        keep_order: Packets never overtake each other (this undoes `reorder`).
        rate: Of the bottleneck [bit/s]; None has none.
        queue_packets: Packets at the bottleneck, the one on the wire included, beyond which the
            next is dropped.
        changes: Time line, strictly rising in `at`.
        trace: Measured delay over time.
        blackouts: In any order; they may overlap.
    """

    delay: float = 0.0
    jitter: float = 0.0
    distribution: Literal["uniform", "normal", "pareto", "table"] = "uniform"
    correlation: float = 0.0
    loss: Loss = 0.0
    duplicate: float = 0.0
    reorder: float = 0.0
    corrupt: float = 0.0
    keep_order: bool = False
    rate: float | None = None
    queue_packets: int = 1000
    changes: tuple[Change, ...] = ()
    trace: Trace | None = None
    blackouts: tuple[Blackout, ...] = ()
    table: tuple[float, ...] = ()
