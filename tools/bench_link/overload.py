"""100,000 packets a second for 10 s: what our relay does with them, and how it is afterwards."""

from __future__ import annotations

import time
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from cloudrc.link.profile import DirectionProfile
from tools.bench_link.flow import Way, run_flow
from tools.bench_link.judge import judge
from tools.bench_link.relays import DELAY, ours
from tools.bench_link.release import LINK, Sink, flood

REST = 1.0
"""Between the flood and the flow that has to be served as before it [s]."""
FLOW_RATE = 200.0
FLOW_DURATION = 3.0


@dataclass(frozen=True)
class Served:
    """How a flow was served.

    Attributes:
        lost: Packets that did not arrive.
        p50: Median of the release error [s].
        p99: Its 99th percentile [s].
    """

    lost: int
    p50: float
    p99: float


@dataclass(frozen=True)
class Overloaded:
    """What came of a flood.

    Attributes:
        offered: Packets sent.
        rate: At which they were sent [1/s].
        counts: What the relay says it did with them, and with both flows.
        memory: Most that the relay held before and after the flood [bytes].
        before: How a flow was served before the flood.
        after: How the same flow was served after it.
    """

    offered: int
    rate: float
    counts: dict[str, float]
    memory: tuple[int, int]
    before: Served
    after: Served

    @property
    def accounted(self) -> float:
        """Which share of what was offered the relay has counted, in [0, 1]."""
        flows = 2 * FLOW_RATE * FLOW_DURATION
        return (self.counts["received"] + self.counts["unread"] - flows) / self.offered

    @property
    def recovered(self) -> bool:
        """Whether service is as before: nothing lost, errors at most twice as large."""
        before, after = self.before, self.after
        return after.lost == 0 and after.p50 <= 2 * before.p50 and after.p99 <= 2 * before.p99


def measure_overload(folder: Path, rate: float, duration: float) -> Overloaded:
    """Send a flow, flood, rest, and send the flow again.

    Args:
        folder: For files.
        rate: Packets offered [1/s].
        duration: Of the flood [s].

    Returns:
        What came of it.
    """
    relay = ours(folder, LINK)
    way = relay.ways[0]
    served, held = _serve(way), relay.memory()
    # Nobody reads what arrives: its kernel drops it, and the sender keeps its core to itself.
    with Sink(way):
        began = time.monotonic()
        offered = flood(way, rate, duration, first=1 << 40)
        took = time.monotonic() - began
        time.sleep(REST)
    held_then, served_then = relay.memory(), _serve(way)
    relay.stop()
    counts, memory = relay.counts(), (held, held_then)
    return Overloaded(offered, offered / took, counts, memory, served, served_then)


def _serve(way: Way) -> Served:
    (flow,) = run_flow([way], FLOW_RATE, FLOW_DURATION, 0.2)
    judged = judge(flow, DirectionProfile(DELAY), 1, min(flow.sent.values()))
    p50, p99 = np.quantile(judged.errors, (0.5, 0.99)).tolist()
    return Served(judged.wrongly_lost, p50, p99)
