# SPDX-License-Identifier: Apache-2.0

"""Send numbered probes through both directions of a link and measure their delays.

One thread sends and receives at both ends with the same clock. The thread takes the time just
before it sends a probe. The kernel records the time of arrival (SO_TIMESTAMPNS), so a late thread
does not increase the measured delay.
"""

from __future__ import annotations

import gc
import select
import socket
import time
from collections.abc import Sequence
from contextlib import suppress
from math import ceil, inf

import numpy as np

from cloudrc.link.carry.datagrams import send_or_lose
from cloudrc.link.carry.udp import (
    ANCILLARY_SIZE,
    DATAGRAM_MAX,
    Stamps,
    ask_for_stamps,
)
from cloudrc.link.model import HEADER_BYTES
from cloudrc.link.profile import DirectionProfile, LinkSchedule
from cloudrc.link.streams import Stream
from cloudrc.link.verify.judge import Flow, Measurement
from cloudrc.wire.tunnel.codec import Direction, encode_header, peek

PROBE = 254  # kind of datagram in the header of probes; world and cloud reject this kind
FIRST_PROBE = 1.0  # time from the start of the link to the first probe [s]
COUNT = 1500  # smallest number of probes, if the user does not specify a duration
LONGEST, AFTER = 120.0, 5.0
"""Longest duration of a measurement; how long it goes on after the profile's last change [s]."""
RATE, LINK_SHARE = 200.0, 0.4
"""Largest number of probes per second [1/s], halved for netem; largest share of a limited rate that
single probes use, in [0, 1]."""
RATE_MAX = 1e8  # largest rate limit of a profile that this process can measure [bit/s]
TRAIN_SIZE, TRAIN_SPAN = 1400, 0.06
"""If the profile limits the rate: size of a probe's UDP payload [bytes], one Ethernet frame; and
shortest transmission time of a train, which is a group of probes sent back to back [s]."""
_BUFFER = 4_000_000


def plan_probes(
    profile: DirectionProfile, flow: Flow, seconds: float | None = None, *, drawn: bool = False
) -> Measurement:
    """Plan when to send probes, for `seconds` [s].

    Without `seconds`, the duration is long enough for a verdict, and covers the profile's schedule
    up to a limit. If the profile limits the rate, the probes are large, and half of them are sent
    in trains to measure the rate. `drawn` is True for netem: nobody can predict its random
    numbers, so a verdict may need more probes.
    """
    schedule, train, step = LinkSchedule(profile), 0, (2.0 if drawn else 1.0) / RATE
    if (rate := min(piece.rate or inf for piece in schedule.pieces)) <= RATE_MAX:
        flow = flow._replace(size=TRAIN_SIZE)
        wire = (TRAIN_SIZE + HEADER_BYTES) * 8.0 / rate
        train = max(4, min(64, profile.queue_packets // 2, ceil(TRAIN_SPAN / wire)))
        step = max(step, wire / LINK_SHARE)
    block = np.minimum(np.arange(float(2 * train or 1)), train) * step
    length = step * len(block)

    def plan(time: float) -> Measurement:
        starts = FIRST_PROBE + np.arange(ceil(max(time, 2 * step) / length)) * length
        return Measurement(profile, flow, (starts[:, None] + block).ravel(), train)

    last = schedule.last_ns * 1e-9
    if seconds or last or not drawn:
        return plan(seconds or max(COUNT * step, min(last + AFTER, LONGEST) if last else 0.0))
    return plan(max(COUNT * step, min(plan(COUNT * step).needed() * step, LONGEST)))


class ProbeEnd:
    """Sends the probes of one direction through its socket, and records their arrivals."""

    def __init__(
        self, own: socket.socket, route: tuple[str, int], plan: Measurement, origin_ns: int
    ) -> None:
        """Prepare to send the probes of `plan` from the socket `own`, which the caller closes.

        `route` is the address to send to; `origin_ns` is when the link came up, wall clock [ns].
        """
        own.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, _BUFFER)
        ask_for_stamps(own)
        self.socket, self.route, self.plan, self.origin_ns = own, route, plan, origin_ns
        count = len(plan.sent)
        self.probes = [self._encode(number) for number in range(count)]
        self._stamps, self._sent_ns = Stamps(), np.zeros(count, dtype=np.int64)
        self._delays, self._copies = np.full(count, inf), np.zeros(count, int)

    def _encode(self, number: int) -> bytes:
        """Encode a probe: its header, repeated up to the full size, so that damage is noticed."""
        _, uplink, kind, size, _ = self.plan.flow
        way = Direction.UPLINK if uplink else Direction.DOWNLINK
        header = encode_header(kind, way, 1, number)
        return (header * (size // len(header) + 1))[:size]

    def send(self, number: int) -> None:
        """Send a probe; a probe that the kernel does not take counts as lost."""
        self._sent_ns[number] = time.time_ns()
        send_or_lose(self.socket, self.probes[number], self.route)

    def receive(self, far: socket.socket) -> None:
        """Read a datagram from the other end's socket `far`; record this end's probes."""
        with suppress(OSError, ValueError):  # no receiver of an earlier probe; not a probe
            data, ancillary, _, _ = far.recvmsg(DATAGRAM_MAX, ANCILLARY_SIZE)
            at_ns, number = self._stamps.wall_ns(ancillary) or time.time_ns(), peek(data)[2]
            if number < len(self.probes) and data == self.probes[number]:
                delay = (at_ns - int(self._sent_ns[number])) * 1e-9
                self._delays[number] = min(self._delays[number], delay)
                self._copies[number] += 1

    def stream(self) -> Stream:
        """Return time of sending, measured delay and number of copies of each probe."""
        delays = np.where(self._copies, self._delays, np.nan)
        return Stream((self._sent_ns - self.origin_ns) * 1e-9, delays, self._copies)


def send_probes(ends: Sequence[ProbeEnd]) -> list[Stream]:
    """Send the probes of both ends to each other; return the measured stream of each direction."""
    heard = {end.socket: other for end, other in zip(ends, reversed(ends), strict=True)}
    drawn = np.concatenate([end.plan.draw(end.plan.sent).delays for end in ends])
    quiet = 0.5 + 2.0 * float(np.max(drawn, initial=0.0, where=drawn > 0.0))
    late = max((time.time_ns() - end.origin_ns) * 1e-9 + 0.05 - FIRST_PROBE for end in ends)
    sends = sorted(
        (end.origin_ns + round((at + max(0.0, late)) * 1e9), place, number)
        for place, end in enumerate(ends)
        for number, at in enumerate(end.plan.sent.tolist())
    )

    def listen(until_ns: int) -> None:
        while (left_ns := until_ns - time.time_ns()) > 0:
            for far in select.select(list(heard), (), (), left_ns * 1e-9)[0]:
                heard[far].receive(far)

    gc.collect()
    gc.disable()  # a garbage collection takes milliseconds
    try:
        for due_ns, place, number in sends:
            listen(due_ns)
            ends[place].send(number)
        listen(time.time_ns() + round(quiet * 1e9))
    finally:
        gc.enable()
    return [end.stream() for end in ends]
