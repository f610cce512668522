"""Packets sent one after the other over one direction of a link: what the tests here share."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from cloudrc.link.model import LinkDirection
from cloudrc.link.profile import DirectionProfile

MS = 1_000_000
PERIOD_NS = 10 * MS
TELEMETRY = 3
SIZE = 172


def link(profile: DirectionProfile, seed: int = 1, uplink: bool = True) -> LinkDirection:
    return LinkDirection(profile, seed, uplink)


def flow(
    profile: DirectionProfile, count: int, seed: int = 1, period_ns: int = PERIOD_NS
) -> list[tuple[int, ...]]:
    """Delays [ns] of each packet's copies, one packet per period."""
    direction = link(profile, seed)
    return [
        tuple(release - n * period_ns for release in releases)
        for n in range(count)
        for releases in [direction.send(1, TELEMETRY, n, SIZE, n * period_ns)]
    ]


def delays(profile: DirectionProfile, count: int, seed: int = 1) -> NDArray[np.float64]:
    """Delays [s] of `count` packets of which none is lost or duplicated."""
    return np.array([delay * 1e-9 for (delay,) in flow(profile, count, seed)])


def losses(profile: DirectionProfile, count: int, seed: int = 1) -> NDArray[np.bool_]:
    """True where a packet is lost."""
    return np.array([not copies for copies in flow(profile, count, seed)])


def bursts(lost: NDArray[np.bool_]) -> list[int]:
    """Lengths of the runs of True."""
    runs, length = [], 0
    for one in [*lost.tolist(), False]:
        if one:
            length += 1
        elif length:
            runs.append(length)
            length = 0
    return runs
