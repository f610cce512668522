"""Send numbered probes through both directions of a link and note when each copy arrives.

One thread and one clock serve both ends. A probe is stamped just before the kernel takes it, and by
the kernel when it arrives (SO_TIMESTAMPNS), so what this process waits in between is not measured.
"""

from __future__ import annotations

import gc
import select
import socket
import time
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass
from math import ceil, inf

import numpy as np

from cloudrc.link.model import HEADER_BYTES, Stream
from cloudrc.link.profile import DirectionProfile, Timeline
from cloudrc.link.relay import ANCILLARY_SIZE, DATAGRAM_MAX, Stamps, ask_for_stamps
from cloudrc.link.verify.judge import Flow, Plan
from cloudrc.tunnel.codec import Direction, encode_header, peek

PROBE = 254
"""Kind of datagram that only probes have; no tunnel end accepts it."""
FIRST_PROBE = 1.0
"""Time from the start of the link to the first probe [s]."""
COUNT = 1500
"""Number of probes; more where chance hides more than a tolerance [1]."""
LONGEST, AFTER = 120.0, 5.0
"""Longest time to probe, and time to probe after the last change of a time line [s]."""
RATE, LINK_SHARE = 200.0, 0.4
"""Most probes per second, half as many through netem [1/s], and share of a bottleneck that they
fill at most, in [0, 1]."""
RATE_MAX = 1e8
"""Highest rate that this process can measure [bit/s]."""
TRAIN_SIZE, TRAIN_SPAN = 1400, 0.06
"""UDP payload of a probe of a train [bytes], one Ethernet frame, and time of a train [s]."""
_BUFFER = 4_000_000


def plan_probes(
    profile: DirectionProfile, flow: Flow, seconds: float | None = None, *, drawn: bool = False
) -> Plan:
    """Choose how many probes to send: for `seconds` [s], else as many as decide.

    A time line is probed as a whole. Probes for a bottleneck are large, and half of them leave in
    trains, which it draws out. `drawn`: the shaper draws its own chance, as netem does.
    """
    timeline, train, step = Timeline(profile), 0, (2.0 if drawn else 1.0) / RATE
    if (rate := min(piece.rate or inf for piece in timeline.pieces)) <= RATE_MAX:
        flow = flow._replace(size=TRAIN_SIZE)
        wire = (TRAIN_SIZE + HEADER_BYTES) * 8.0 / rate
        train = max(4, min(64, profile.queue_packets // 2, ceil(TRAIN_SPAN / wire)))
        step = max(step, wire / LINK_SHARE)
    block = np.minimum(np.arange(float(2 * train or 1)), train) * step
    length = step * len(block)

    def plan(time: float) -> Plan:
        starts = FIRST_PROBE + np.arange(ceil(max(time, 2 * step) / length)) * length
        return Plan(profile, flow, (starts[:, None] + block).ravel(), train)

    last = timeline.last_ns * 1e-9
    if seconds or last or not drawn:
        return plan(seconds or max(COUNT * step, min(last + AFTER, LONGEST) if last else 0.0))
    return plan(max(COUNT * step, min(plan(COUNT * step).needed() * step, LONGEST)))


@dataclass(frozen=True)
class ProbeEnd:
    """One end of the link: what it sends where, and when the link came up [ns, wall clock]."""

    socket: socket.socket
    route: tuple[str, int]
    plan: Plan
    origin_ns: int

    def data(self, number: int) -> bytes:
        """Encode a probe; its header fills all of it, so that damage shows."""
        _, uplink, kind, size = self.plan.flow
        way = Direction.UPLINK if uplink else Direction.DOWNLINK
        header = encode_header(kind, way, 1, number)
        return (header * (size // len(header) + 1))[:size]


def send_probes(ends: Sequence[ProbeEnd]) -> list[Stream]:
    """Send the probes of both ends and listen until none can arrive; return what each measured.

    What the first end sends the second receives, and the other way round.
    """
    probes = [[end.data(number) for number in range(len(end.plan.sent))] for end in ends]
    drawn = [end.plan.draw(end.plan.sent).delays for end in ends]
    longest = max(float(np.max(one, initial=0.0, where=one > 0.0)) for one in drawn)
    sent_ns = [np.zeros(len(end.plan.sent), dtype=np.int64) for end in ends]
    delays = [np.full(len(end.plan.sent), inf) for end in ends]
    copies = [np.zeros(len(end.plan.sent), int) for end in ends]
    stamps = [Stamps(), Stamps()]
    for end in ends:
        end.socket.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, _BUFFER)
        ask_for_stamps(end.socket)

    def receive(far: int) -> None:
        """Note a probe that waits in an end's socket, and nothing else."""
        with suppress(OSError, ValueError):  # nobody listened to an earlier probe; foreign data
            data, ancillary, _, _ = ends[far].socket.recvmsg(DATAGRAM_MAX, ANCILLARY_SIZE)
            at_ns = stamps[far].wall_ns(ancillary) or time.time_ns()
            near, number = 1 - far, peek(data)[2]
            if number < len(probes[near]) and data == probes[near][number]:
                delay = (at_ns - int(sent_ns[near][number])) * 1e-9
                delays[near][number] = min(delays[near][number], delay)
                copies[near][number] += 1

    def listen(until_ns: int) -> None:
        sockets = [end.socket for end in ends]
        while (left_ns := until_ns - time.time_ns()) > 0:
            for ready in select.select(sockets, (), (), left_ns * 1e-9)[0]:
                receive(sockets.index(ready))

    late = max((time.time_ns() - end.origin_ns) * 1e-9 + 0.05 - FIRST_PROBE for end in ends)
    schedule = sorted(
        (end.origin_ns + round((at + max(0.0, late)) * 1e9), near, number)
        for near, end in enumerate(ends)
        for number, at in enumerate(end.plan.sent.tolist())
    )
    gc.collect()
    gc.disable()  # a collection takes milliseconds
    try:
        for due_ns, near, number in schedule:
            listen(due_ns)
            sent_ns[near][number] = time.time_ns()
            with suppress(OSError):  # the kernel refuses it: it does not arrive
                ends[near].socket.sendto(probes[near][number], ends[near].route)
        listen(time.time_ns() + round((0.5 + 2.0 * longest) * 1e9))
    finally:
        gc.enable()
    return [
        Stream((at - end.origin_ns) * 1e-9, np.where(count, delay, np.nan), count)
        for end, at, delay, count in zip(ends, sent_ns, delays, copies, strict=True)
    ]
