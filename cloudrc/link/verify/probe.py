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
"""Number of probes; more where chance hides more than a tolerance."""
LONGEST, AFTER = 120.0, 5.0
"""Longest time to probe, and time to probe after the last change of a time line [s]."""
RATE, LINK_SHARE = 200.0, 0.4
"""Most probes per second, half as many through netem [1/s], and share of a bottleneck that they
fill at most, in [0, 1]."""
RATE_MAX = 1e8
"""Highest rate that this process can measure [bit/s]."""
TRAIN_SIZE, TRAIN_SPAN = 1400, 0.06
"""UDP payload of a probe of a train [bytes], one Ethernet frame, and time of a train [s]."""
_BUFFER, _DRAIN = 4_000_000, 64


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
    found = plan(seconds or max(COUNT * step, min(last + AFTER, LONGEST) if last else 0.0))
    if drawn and not last and not seconds:
        found = plan(max(COUNT * step, min(found.needed() * step, LONGEST)))
    return found


class ProbeEnd:
    """One end of the link: its socket, the caller's to close, and the probes that it sends."""

    def __init__(
        self, own: socket.socket, route: tuple[str, int], plan: Plan, origin_ns: int
    ) -> None:
        """Set up; `route` is where it sends, `origin_ns` when the link came up, wall clock [ns]."""
        own.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, _BUFFER)
        ask_for_stamps(own)
        self.socket, self.plan, self._route, self._origin_ns = own, plan, route, origin_ns
        late = max(0.0, (time.time_ns() - origin_ns) * 1e-9 + 0.05 - float(plan.sent[0]))
        self._due_ns = (origin_ns + np.rint((plan.sent + late) * 1e9)).astype(np.int64).tolist()
        self._stamps = Stamps()
        self._sent_ns, self._arrivals = list[int](), list[tuple[int, int]]()

    def data(self, number: int) -> bytes:
        """Encode a probe; its header fills all of it, so that damage shows."""
        _, uplink, kind, size = self.plan.flow
        way = Direction.UPLINK if uplink else Direction.DOWNLINK
        header = encode_header(kind, way, 1, number)
        return (header * (size // len(header) + 1))[:size]

    def wait(self) -> float:
        """Return the time until the next probe is due [s]; infinite after the last."""
        number = len(self._sent_ns)
        return (self._due_ns[number] - time.time_ns()) * 1e-9 if number < len(self._due_ns) else inf

    def send(self) -> bool:
        """Send the next probe; False if the kernel has no room for it yet."""
        data = self.data(len(self._sent_ns))
        self._sent_ns.append(time.time_ns())
        try:
            self.socket.sendto(data, self._route)
        except BlockingIOError:
            self._sent_ns.pop()
            return False
        except OSError:  # then it does not arrive
            pass
        return True

    def receive(self, own: socket.socket) -> None:
        """Note the probes of this end that wait in the other end's socket, nothing else."""
        for _ in range(_DRAIN):
            try:
                data, ancillary, _, _ = own.recvmsg(DATAGRAM_MAX, ANCILLARY_SIZE)
            except BlockingIOError:
                return
            except OSError:  # an earlier probe found nobody listening
                continue
            at_ns = self._stamps.wall_ns(ancillary) or time.time_ns()
            with suppress(ValueError):
                number = peek(data)[2]
                if number < len(self._sent_ns) and data == self.data(number):
                    self._arrivals.append((number, at_ns))

    def stream(self) -> Stream:
        """Return what was measured."""
        delays, copies = np.full(len(self._sent_ns), np.inf), np.zeros(len(self._sent_ns), int)
        for number, at_ns in self._arrivals:
            delays[number] = min(delays[number], (at_ns - self._sent_ns[number]) * 1e-9)
            copies[number] += 1
        sent = (np.array(self._sent_ns, dtype=np.int64) - self._origin_ns) * 1e-9
        return Stream(sent, np.where(copies, delays, np.nan), copies)


def send_probes(ends: Sequence[ProbeEnd]) -> list[Stream]:
    """Send the probes of both ends and listen until none can arrive; return what each measured.

    What the first end sends the second receives, and the other way round.
    """
    heard = {end.socket: other for end, other in zip(ends, reversed(ends), strict=True)}
    drawn = [end.plan.draw(end.plan.sent).delays for end in ends]
    quiet = 0.5 + 2.0 * max(float(np.max(one, initial=0.0, where=one > 0.0)) for one in drawn)
    gc.collect()
    gc.disable()  # a collection takes milliseconds
    last = time.monotonic()
    try:
        while (wait := min(end.wait() for end in ends)) < inf or time.monotonic() - last < quiet:
            readable, _, _ = select.select(list(heard), (), (), min(max(wait, 0.0), 0.05))
            for own in readable:
                heard[own].receive(own)
            for end in ends:
                while end.wait() <= 0.0 and end.send():
                    pass
            if readable or wait < inf:
                last = time.monotonic()
    finally:
        gc.enable()
    return [end.stream() for end in ends]
