"""Bursts of loss as the model draws them, against what was asked: no clock, no socket."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import groupby

from cloudrc.link.model import LinkDirection
from cloudrc.link.profile import DirectionProfile, GilbertElliott
from tools.bench_link.flow import SIZE

PERIOD_NS = 10_000_000


@dataclass(frozen=True)
class Bursts:
    """Asked and drawn.

    Attributes:
        loss_asked: Stationary share that is lost, in [0, 1].
        loss_drawn: Share of the packets that were lost, in [0, 1].
        length_asked: Mean run of lost packets [1].
        length_drawn: Likewise.
    """

    loss_asked: float
    loss_drawn: float
    length_asked: float
    length_drawn: float


def measure_bursts(start: float = 0.02, end: float = 0.2, count: int = 200_000) -> Bursts:
    """Draw the fates of many packets.

    Args:
        start: Chance per packet that a burst begins, in [0, 1].
        end: Chance per packet that it ends, in [0, 1].
        count: Of packets.

    Returns:
        What was asked and what was drawn.
    """
    link = LinkDirection(DirectionProfile(loss=GilbertElliott(start, end)), 1, True)
    lost = [not link.send(1, 3, n, SIZE, n * PERIOD_NS) for n in range(count)]
    runs = [sum(1 for _ in run) for one, run in groupby(lost) if one]
    return Bursts(start / (start + end), sum(lost) / count, 1.0 / end, sum(runs) / len(runs))
