"""100,000 packets a second for 10 s: what our relay does with them, and how it is afterwards."""

from __future__ import annotations

import time
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from cloudrc.link.profile import DirectionProfile
from tools.bench_link.flow import run_flow
from tools.bench_link.judge import judge
from tools.bench_link.relays import DELAY, ours
from tools.bench_link.release import LINK, Sink, flood

REST = 1.0
"""Between the flood and the flow that has to be served as usual [s]."""
FLOW_RATE = 100.0
FLOW_DURATION = 3.0


@dataclass(frozen=True)
class Overloaded:
    """What came of a flood.

    Attributes:
        offered: Packets sent.
        rate: At which they were sent [1/s].
        counts: What the relay says it did with them, and with the flow afterwards.
        memory: Most that the relay held before and after the flood [bytes].
        lost: Of the flow afterwards.
        error_p50: Release error of the flow afterwards [s].
        error_p99: Likewise.
    """

    offered: int
    rate: float
    counts: dict[str, float]
    memory: tuple[int, int]
    lost: int
    error_p50: float
    error_p99: float

    @property
    def accounted(self) -> float:
        """Which share of what was offered the relay has counted, in [0, 1]."""
        flow = FLOW_RATE * FLOW_DURATION
        return (self.counts["received"] + self.counts["unread"] - flow) / self.offered


def measure_overload(folder: Path, rate: float, duration: float) -> Overloaded:
    """Flood, rest, and send a flow.

    Args:
        folder: For files.
        rate: Packets offered [1/s].
        duration: Of the flood [s].

    Returns:
        What came of it.
    """
    relay = ours(folder, LINK)
    way = relay.ways[0]
    before = relay.memory()
    # Nobody reads what arrives: its kernel drops it, and the sender keeps its core to itself.
    with Sink(way):
        began = time.monotonic()
        offered = flood(way, rate, duration, first=1 << 40)
        took = time.monotonic() - began
        time.sleep(REST)
    after = relay.memory()
    (flow,) = run_flow([way], FLOW_RATE, FLOW_DURATION, 0.2)
    relay.stop()
    judged = judge(flow, DirectionProfile(DELAY), 1, min(flow.sent.values()))
    return Overloaded(
        offered,
        offered / took,
        relay.counts(),
        (before, after),
        judged.wrongly_lost,
        float(np.median(judged.errors)),
        float(np.quantile(judged.errors, 0.99)),
    )
