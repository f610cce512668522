"""Receive the segments of a stream at the far end of the link: order them, and acknowledge them.

Source: Linux, net/ipv4/tcp_input.c: the first 16 segments are acknowledged at once, then every
second one. Deviation: the last segment on its way is acknowledged at once, as if an answer took the
acknowledgement along.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable

from cloudrc.link.relay_tcp.agenda import Agenda
from cloudrc.link.relay_tcp.congestion import SentSegment
from cloudrc.link.relay_tcp.medium import Medium

AT_ONCE = 16  # segments of a new connection that are acknowledged at once


class Segment:
    """Some bytes of the stream; `data` is empty for the end of the stream."""

    __slots__ = ("acked", "arrived", "attempts", "crossing", "data", "number", "place", "sent")

    def __init__(self, data: bytes, number: int, place: int) -> None:
        self.data, self.number, self.place = data, number, place
        self.attempts, self.sent = 0, SentSegment(0)
        self.arrived = self.acked = False
        self.crossing = False  # whether the sender believes that it is on its way


Transmission = tuple[Segment, int]
"""A segment, and the number of the attempt to send it."""


class Receiver:
    """The far end of a stream."""

    def __init__(
        self,
        agenda: Agenda,
        back: Medium,
        deliver: Callable[[bytes, int], None],
        answer: Callable[[list[Transmission], int], None],
    ) -> None:
        """Deliver bytes by `deliver`, and acknowledge over `back`: `answer` is called there."""
        self._agenda, self._back, self._deliver, self._answer = agenda, back, deliver, answer
        self._order = deque[Segment]()  # not delivered yet, in the order of the bytes
        self._pending: list[Transmission] = []  # not acknowledged yet
        self._coming = self._arrivals = 0  # transmissions on their way, and arrived
        self._early = 0  # segments that have arrived before an earlier one of the stream
        self._answer_ns = 0

    def expect(self, segment: Segment) -> None:
        """Note the next segment of the stream."""
        self._order.append(segment)

    def await_arrival(self, segment: Segment, arrival_ns: int) -> None:
        """Let a transmission of a segment arrive at `arrival_ns` [ns]."""
        self._coming += 1
        self._agenda.at(arrival_ns, self._arrive, (segment, segment.attempts))

    def _arrive(self, transmission: Transmission, now_ns: int) -> None:
        """Deliver a segment, and all that have waited for it; acknowledge it, or wait for one."""
        segment, _ = transmission
        self._coming -= 1
        self._arrivals += 1
        self._pending.append(transmission)
        if not segment.arrived:
            segment.arrived = True
            self._early += 1
            self._deliver_in_order(now_ns)
        is_second = len(self._pending) > 1
        if is_second or self._early or not self._coming or self._arrivals <= AT_ONCE:
            self._answer_ns = max(self._answer_ns, self._back.arrival_ns(now_ns))
            self._agenda.at(self._answer_ns, self._answer, self._pending)
            self._pending = []

    def _deliver_in_order(self, now_ns: int) -> None:
        parts, ends = [], False
        while self._order and self._order[0].arrived:
            data = self._order.popleft().data
            self._early -= 1
            parts.append(data)
            ends |= not data
        if whole := b"".join(parts):
            self._deliver(whole, now_ns)
        if ends:
            self._deliver(b"", now_ns)
