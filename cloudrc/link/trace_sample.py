"""What a profile does to a stream: one direction of the link goes in, its packets' fates come out.

The model itself is asked, packet by packet, so the numbers are those of a flight.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

from cloudrc.link.model import LinkDirection

Array: TypeAlias = NDArray[Any]


@dataclass(frozen=True, slots=True)
class Stream:
    """Packets of one direction in the order of sending, n of them.

    Attributes:
        sent: When each left, since the link came up [s], shape (n,).
        delays: One way [s], NaN for the lost; of copies the first to arrive, shape (n,).
        copies: How many of each arrived [1], shape (n,).
    """

    sent: Array
    delays: Array
    copies: Array


@dataclass(frozen=True, slots=True)
class Numbers:
    """A stream in numbers; a float that cannot be known is NaN.

    Attributes:
        mean: Of the delay [s].
        deviation: Its standard deviation [s].
        least: Shortest delay [s].
        median: Of the delay [s].
        p99: Its 99 % quantile [s].
        most: Longest delay [s].
        correlation: Of the delay of one packet with that of the next [1].
        loss: Share that did not arrive, in [0, 1].
        runs: Losses in a row, one entry per run.
        overtaken: Share of those that arrived after one that was sent later, in [0, 1].
            Source: RFC 4737, section 3.
        duplicated: Share of those of which two copies arrived, in [0, 1].
    """

    mean: float
    deviation: float
    least: float
    median: float
    p99: float
    most: float
    correlation: float
    loss: float
    runs: tuple[int, ...]
    overtaken: float
    duplicated: float


def sample(link: LinkDirection, kind: int, count: int, period_ns: int, size: int) -> Stream:
    """Send packets at a steady rate.

    Args:
        link: Fresh: its origin is 0.
        kind: Message type in the header.
        count: How many.
        period_ns: Between two of them [ns].
        size: UDP payload of each [bytes].
    """
    delays = np.full(count, np.nan)
    copies = np.zeros(count, dtype=np.int64)
    for n in range(count):
        now_ns = n * period_ns
        releases = link.send(1, kind, n, size, now_ns)
        if releases:
            delays[n] = (min(releases) - now_ns) * 1e-9
            copies[n] = len(releases)
    return Stream(np.arange(count) * (period_ns * 1e-9), delays, copies)


def numbers(stream: Stream) -> Numbers:
    """Put a stream into numbers."""
    arrived = np.isfinite(stream.delays)
    delays = stream.delays[arrived]
    if not len(delays):
        delays = np.array([np.nan])
    both = arrived[1:] & arrived[:-1]
    pairs = stream.delays[:-1][both], stream.delays[1:][both]
    varies = len(pairs[0]) > 2 and min(np.std(pairs[0]), np.std(pairs[1])) > 0
    arrival = np.rint((stream.sent + stream.delays)[arrived] * 1e9).astype(np.int64)
    # Released at one instant, packets leave in the order in which they came.
    earliest_after = np.minimum.accumulate(arrival[::-1])[::-1][1:]
    overtaken = arrival[:-1] > earliest_after
    least, middle, p99, most = np.quantile(delays, (0.0, 0.5, 0.99, 1.0)).tolist()
    return Numbers(
        mean=float(np.mean(delays)),
        deviation=float(np.std(delays)),
        least=least,
        median=middle,
        p99=p99,
        most=most,
        correlation=float(np.corrcoef(*pairs)[0, 1]) if varies else float("nan"),
        loss=float(np.mean(~arrived)),
        runs=loss_runs(stream),
        overtaken=float(np.mean(overtaken)) if len(overtaken) else float("nan"),
        duplicated=float(np.mean(stream.copies > 1)),
    )


def loss_runs(stream: Stream) -> tuple[int, ...]:
    """Count the packets of each run of losses, in order."""
    lost = np.concatenate(([0], np.isnan(stream.delays).astype(np.int8), [0]))
    edges = np.flatnonzero(np.diff(lost))
    return tuple((edges[1::2] - edges[::2]).tolist())
