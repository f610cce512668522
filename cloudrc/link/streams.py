# SPDX-License-Identifier: Apache-2.0

"""Send many packets through the model of a link, and compute statistics of their delays."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cloudrc.base.rounding import differences
from cloudrc.link.model import LinkDirection

Array = NDArray[Any]


@dataclass(frozen=True, slots=True)
class Stream:
    """n packets of one direction in the order of sending; each array has the shape (n,)."""

    sent: Array  # times of sending, since the link came up [s]
    delays: Array  # one-way delay of the copy that arrives first [s]; NaN if lost or not known
    copies: Array  # number of copies of each packet that arrived [1]


@dataclass(frozen=True, slots=True)
class Numbers:
    """Statistics of a stream; an unknown value is NaN.

    Source: RFC 4737, sections 3 and 4.1, for `overtaken`.
    """

    mean: float  # mean delay [s]
    deviation: float  # standard deviation of the delay [s]
    least: float  # shortest delay [s]
    median: float  # median of the delay [s]
    p99: float  # 99th percentile of the delay [s]
    most: float  # longest delay [s]
    correlation: float  # correlation of the delays of successive packets [1]
    loss: float  # share of packets that did not arrive, in [0, 1]
    runs: tuple[int, ...]  # length of each run of successive losses
    overtaken: float  # share of arrived packets that a later packet overtook, in [0, 1]
    duplicated: float  # share of packets of which two copies arrived, in [0, 1]


def sample(
    link: LinkDirection,
    kind: int,
    sent_ns: Sequence[int],
    size: int,
    *,
    epoch: int = 1,
    first: int = 0,
    turn: int = 1 << 62,
    pause: Callable[[], None] = lambda: None,
) -> Stream:
    """Send packets of `size` bytes through the model of a link; return their delays.

    `sent_ns` are the times of sending since the link came up, rising [ns]. `first` is the counter
    of the first packet. After `turn` packets the next epoch begins. Damaged packets count as lost,
    because the receiver rejects them. `pause` is called every few hundred microseconds, so that
    other threads can run.
    """
    delays, copies = np.full(len(sent_ns), np.nan), np.zeros(len(sent_ns), dtype=np.int64)
    whole = bytes(size or 1)
    for n, now_ns in enumerate(sent_ns):
        own = epoch + n // turn
        releases = link.send(own, kind, first + n, size, now_ns)
        if link.corrupts and link.corrupted(own, kind, first + n, whole) != whole:
            continue
        if releases:
            delays[n], copies[n] = (min(releases) - now_ns) * 1e-9, len(releases)
        if n % 128 == 0:
            pause()
    return Stream(np.array(sent_ns) * 1e-9, delays, copies)


def numbers(stream: Stream) -> Numbers:
    """Compute the statistics of a stream of packets, such as mean delay and loss."""
    arrived = np.isfinite(stream.delays)  # with a known delay
    delays = stream.delays[arrived]
    if not len(delays):
        delays = np.array([np.nan])
    both = arrived[1:] & arrived[:-1]
    pairs = stream.delays[:-1][both], stream.delays[1:][both]
    varies = len(pairs[0]) > 2 and all(_varies(each) for each in pairs)
    arrival = np.rint((stream.sent + stream.delays)[arrived] * 1e9).astype(np.int64)
    # Packets with the same arrival time keep their order.
    earliest_after = np.minimum.accumulate(arrival[::-1])[::-1][1:]
    overtaken = arrival[:-1] > earliest_after
    least, middle, p99, most = np.quantile(delays, (0.0, 0.5, 0.99, 1.0)).tolist()
    return Numbers(
        mean=float(np.mean(delays)),
        deviation=float(np.std(delays)) if _varies(delays) else 0.0,
        least=least,
        median=middle,
        p99=p99,
        most=most,
        correlation=float(np.corrcoef(*pairs)[0, 1]) if varies else float("nan"),
        loss=float(np.mean(stream.copies == 0)),
        runs=loss_runs(stream),
        overtaken=float(np.sum(overtaken)) / len(arrival) if len(arrival) else float("nan"),
        duplicated=float(np.mean(stream.copies > 1)),
    )


def _varies(delays: Array) -> bool:
    """Return whether delays [s], shape (n,), differ by more than rounding."""
    return bool(differences(delays.min(), delays.max()))


def loss_runs(stream: Stream) -> tuple[int, ...]:
    """Return the length of each run of successive losses, in the order of sending."""
    lost = np.concatenate(([0], (stream.copies == 0).astype(np.int8), [0]))
    edges = np.flatnonzero(np.diff(lost))
    return tuple((edges[1::2] - edges[::2]).tolist())
