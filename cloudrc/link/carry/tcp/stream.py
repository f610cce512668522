"""Carry one direction of a TCP connection over the link, without sockets.

A segment crosses with the delay, the rate and the queue of the link. The far end hands bytes on in
order, so a lost segment holds up those behind it until it is repaired:

    a later segment arrives   sent again once the news of it is back: one round trip in all
    nothing shows the loss    sent again after a round trip and 200 ms, then twice this, ...

Source: RFC 6298, the retransmission time-out with Linux' minimum of 200 ms.
Deviation: this is no congestion control: a sender waits for the link's queue and for the receiver
alone. Acknowledgements take the link's delay, and are never lost.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from dataclasses import dataclass

from cloudrc.link.carry.tcp.medium import SEGMENT, Medium
from cloudrc.link.queue import NOTHING_NS, PacketQueue

WINDOW_BYTES = 3 << 20  # most bytes that are sent and that the receiver has not taken [bytes]
READ_AHEAD = 256 << 10  # most bytes that wait to be sent [bytes]
RETRY_MIN_NS = 200_000_000  # time beyond a round trip until a segment is sent again [ns]
DOUBLINGS = 8  # times that this wait doubles


def run_due(agenda: PacketQueue, now_ns: int) -> None:
    """Make all calls that are due at `now_ns` [ns]; `put(call, (time_ns,), arguments)` adds one.

    Each call gets the time at which it was due, so that a late caller does not slow a stream.
    """
    while agenda.next_ns <= now_ns:
        time_ns, call, arguments = agenda.pop()
        call(*arguments, time_ns)


@dataclass(slots=True, eq=False)
class Segment:
    """Some bytes of the stream; `data` is empty for the end of the stream."""

    data: bytes
    number: int  # of the segment in its stream
    attempt: int = 1
    arrived: bool = False


class LinkStream:
    """One direction of a connection: bytes enter by `write`, and leave by the call `deliver`.

    All times are on the clock of the agenda [ns].
    """

    def __init__(
        self,
        agenda: PacketQueue,
        way: tuple[Medium, Medium],
        connection: int,
        deliver: Callable[[bytes, int], None],
    ) -> None:
        """Make an empty stream, which sends nothing before `open`.

        `way` is the direction of the bytes and that of the acknowledgements. `deliver` gets the
        bytes and the time; b"" is the end of the stream.
        """
        self._agenda, self._connection, self._deliver = agenda, connection, deliver
        self._way, self._back = way
        self._unsent, self._ending, self._ended = bytearray(), False, False
        self._again = deque[Segment]()  # lost, to be sent again
        self._missing = deque[tuple[int, Segment, int]]()  # transmission, lost segment, attempt
        self._order = deque[Segment]()  # not delivered yet, in the order of the bytes
        self._count = self._transmissions = 0  # segments, and how often they were sent
        self._bytes = 0  # sent, and not taken by the receiver
        self._start_ns, self._arrival_ns, self._wakes_ns = NOTHING_NS, 0, 0

    @property
    def room(self) -> int:
        """Number of bytes that the stream accepts now."""
        return 0 if self._ending else max(0, READ_AHEAD - len(self._unsent))

    def open(self, start_ns: int) -> None:
        """Send from the time `start_ns` on [ns]."""
        self._start_ns = start_ns
        self._agenda.put(self._pump, (start_ns,), ())

    def write(self, data: bytes, now_ns: int) -> None:
        """Send bytes; b"" ends the stream."""
        self._unsent += data
        self._ending |= not data
        self._pump(now_ns)

    def taken(self, count: int, now_ns: int) -> None:
        """Note that the receiver has taken bytes, so that more may be sent."""
        self._bytes -= count
        self._pump(now_ns)

    def _pump(self, now_ns: int) -> None:
        """Send what the queue of the link and the receiver have room for, lost segments first."""
        if now_ns < self._start_ns:
            return
        while self._again or self._has_more():
            room_ns = self._way.room_ns(now_ns)
            if room_ns > now_ns:
                if self._wakes_ns <= now_ns:  # else it wakes already
                    self._wakes_ns = room_ns
                    self._agenda.put(self._pump, (room_ns,), ())
                return
            self._send(self._again.popleft() if self._again else self._next_segment(), now_ns)

    def _has_more(self) -> bool:
        """Return whether a new segment may be sent, or the end of the stream."""
        waits = bool(self._unsent) or (self._ending and not self._ended)
        return waits and self._bytes < WINDOW_BYTES

    def _next_segment(self) -> Segment:
        segment = Segment(bytes(self._unsent[:SEGMENT]), self._count)
        del self._unsent[:SEGMENT]
        self._count += 1
        self._bytes += len(segment.data)
        self._ended = not segment.data
        self._order.append(segment)
        return segment

    def _send(self, segment: Segment, now_ns: int) -> None:
        self._transmissions += 1
        size, attempt = len(segment.data), segment.attempt
        arrival_ns = self._way.cross(self._connection, segment.number, attempt, size, now_ns)
        if arrival_ns is not None:  # a segment overtakes no other one of its connection
            self._arrival_ns = max(self._arrival_ns, arrival_ns)
            self._agenda.put(self._arrive, (self._arrival_ns,), (segment, self._transmissions))
            return
        self._missing.append((self._transmissions, segment, attempt))
        trip_ns = self._way.delay_ns(now_ns) + self._back.delay_ns(now_ns)
        wait_ns = (trip_ns + RETRY_MIN_NS) << min(attempt - 1, DOUBLINGS)
        retry_ns = max(now_ns, self._arrival_ns) + wait_ns
        self._agenda.put(self._repair, (retry_ns,), (segment, attempt))

    def _arrive(self, segment: Segment, transmission: int, now_ns: int) -> None:
        """Deliver what has waited for a segment; it shows the losses of those sent before it."""
        segment.arrived = True
        news_ns = now_ns + self._back.delay_ns(now_ns)
        while self._missing and self._missing[0][0] < transmission:
            _, lost, attempt = self._missing.popleft()
            self._agenda.put(self._repair, (news_ns,), (lost, attempt))
        parts, ends = [], False
        while self._order and self._order[0].arrived:
            parts.append(self._order.popleft().data)
            ends = not parts[-1]
        if whole := b"".join(parts):
            self._deliver(whole, now_ns)
        if ends:
            self._deliver(b"", now_ns)

    def _repair(self, segment: Segment, attempt: int, now_ns: int) -> None:
        """Send a lost segment again, unless it has been."""
        if segment.attempt == attempt:
            segment.attempt += 1
            self._again.append(segment)
            self._pump(now_ns)
