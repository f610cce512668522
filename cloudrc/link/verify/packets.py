# SPDX-License-Identifier: Apache-2.0

"""Judge what a relay between two programs did, by the times at which packets entered and left."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from math import nan

import numpy as np

from cloudrc.link.carry.log import LOST, PacketLog
from cloudrc.link.library import KIND, PACKET_BYTES
from cloudrc.link.model import HEADER_BYTES
from cloudrc.link.profile import DirectionProfile, LinkSchedule
from cloudrc.link.streams import Stream
from cloudrc.link.verify.judge import Flow, Judgement, Measurement

HEAD = "time_s,delay_ms,applied_ms,bytes"
"""Columns of a recording of packets: time of sending since the link came up, the delay that was
measured, the delay that the model computed, and the size of the IP packet."""
UNJUDGED = {"distribution"}
"""Quantity that needs no comparison, because the delay of every packet is compared."""
ASKED_PACKETS = 1000
"""Number of packets in a simulation of what the profile asks for."""
QUEUED_PACKETS = 10_000
"""Largest number of packets, from the first on, in that of a profile with a bottleneck."""


@dataclass(frozen=True)
class Period:
    """The packets of one direction from the last change of the link on."""

    profile: DirectionProfile
    seed: int
    uplink: bool
    first: int  # number of the first packet
    origin_ns: int  # start of the profile's schedule, monotonic clock [ns]
    cuts: bool = False  # whether large messages travel as several packets


def judge_packets(log: PacketLog, period: Period) -> list[tuple[float, Judgement]]:
    """Judge the packets of one direction.

    Returns:
        What the profile asks for (NaN if it cannot be known) and the judgement, per quantity. The
        judgement's `asked` is what the model has computed for these very packets. At a bottleneck
        the profile asks for what packets of the same times and of one mean size would meet.
    """
    applied, measured = streams(log, period)
    if not len(applied.sent):
        return []
    size = round(np.mean(log.size[period.first :])) - HEADER_BYTES
    flow = Flow(period.seed, period.uplink, KIND, size)
    plan = Measurement(period.profile, flow, applied.sent)
    limited = any(piece.rate is not None for piece in LinkSchedule(period.profile).pieces)
    few = slice(None, None, 1 + len(applied.sent) // ASKED_PACKETS)
    if limited:  # a packet waits for those before it
        few = slice(QUEUED_PACKETS)
    asked = replace(plan, sent=applied.sent[few]).asked()
    if period.cuts and size > PACKET_BYTES:  # only the applied values of such a message are known
        asked = dict.fromkeys(asked, nan)
    if not limited:
        asked["reordered"] = nan  # depends on how close to each other packets are sent
    rows = plan.judge_applied(applied, measured)
    return [(asked.get(row.name, row.asked), row) for row in rows if row.name not in UNJUDGED]


def streams(log: PacketLog, period: Period) -> tuple[Stream, Stream]:
    """Return the packets as the model computed them, and as they left the relay."""
    count = len(log.copies)
    sent, due, left = (
        np.array(part[period.first : count]) for part in (log.sent, log.due, log.left)
    )
    copies = np.array(log.copies[period.first : count], dtype=np.int64)
    since = (sent - period.origin_ns) * 1e-9
    arrived = due != LOST
    known = ~arrived | (left != LOST)  # a packet in flight at the end is not lost
    delays = [np.where(each == LOST, nan, (each - sent) * 1e-9)[known] for each in (due, left)]
    return (
        Stream(since[known], delays[0], np.where(arrived, np.maximum(copies, 1), 0)[known]),
        Stream(since[known], delays[1], copies[known]),
    )


def recording(log: PacketLog, origin_ns: int) -> Iterator[str]:
    """Yield the lines of a recording, as `cloudrc link record` reads them; a loss has no delay."""
    yield HEAD
    rows = zip(log.sent, log.left, log.due, log.size, strict=False)
    for sent, left, due, size in rows:
        delay = "" if left == LOST else f"{(left - sent) * 1e-6:.4f}"
        applied = "" if due < 0 else f"{(due - sent) * 1e-6:.4f}"
        yield f"{(sent - origin_ns) * 1e-9:.6f},{delay},{applied},{size}"
