# SPDX-License-Identifier: Apache-2.0

"""Carry one direction of a connection that repairs losses over the link, without sockets.

A segment crosses with the delay, the rate and the queue of the link. The far end hands on what
arrives in order, so a lost segment holds up those behind it until it is repaired:

    a later segment arrives   sent again once the news of it is back: one round trip in all
    nothing shows the loss    sent again after a round trip and 200 ms, then twice this, ...

`LinkStream` carries the bytes of TCP connections, `MessageStream` messages that have a number each.

Source: RFC 6298, the retransmission time-out with Linux' minimum of 200 ms.
Deviation: this is no congestion control: a sender waits for the link's queue and for the receiver
alone. Acknowledgements take the link's delay, and are never lost.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from cloudrc.link.carry.tcp.medium import SEGMENT, Medium
from cloudrc.link.library import KIND, Cut
from cloudrc.link.queue import NOTHING_NS, PacketQueue

WINDOW_BYTES = 3 << 20  # most bytes that are sent and that the receiver has not taken [bytes]
READ_AHEAD = 256 << 10  # most bytes that wait to be sent [bytes]
RETRY_MIN_NS = 200_000_000  # time beyond a round trip until a segment is sent again [ns]
DOUBLINGS = 8  # times that this wait doubles
REPAIR = 200  # kind of the repairs of messages, less the number of the attempt
_BEYOND = 1 << 62  # added to the counter of a repair of a piece beyond the usual number


def run_due(agenda: PacketQueue, now_ns: int) -> None:
    """Make all calls that are due at `now_ns` [ns]; `put(call, (time_ns,), arguments)` adds one.

    Each call gets the time at which it was due, so that a late caller does not slow a stream.
    """
    while agenda.next_ns <= now_ns:
        time_ns, call, arguments = agenda.pop()
        call(*arguments, time_ns)


@dataclass(slots=True, eq=False)
class Segment:
    """A part of the stream that one packet carries."""

    data: Any
    size: int  # [bytes]
    kind: int  # with the counter, it selects the random numbers of the first transmission
    counter: int
    attempt: int = 1
    arrived: bool = False


class RepairedStream:
    """Segments that arrive in order. A subclass says what is sent, and takes what has arrived.

    All times are on the clock of the agenda [ns].

    Attributes:
        transmissions: How often segments were sent.
        lost: How many of these were lost.
    """

    def __init__(self, agenda: PacketQueue, way: tuple[Medium, Medium], epoch: int) -> None:
        """Make an empty stream; `way` is its direction and that of the acknowledgements."""
        self._agenda, self._epoch = agenda, epoch
        self._way, self._back = way
        self._again = deque[Segment]()  # lost, to be sent again
        self._missing = deque[tuple[int, Segment, int]]()  # transmission, lost segment, attempt
        self._order = deque[Segment]()  # not delivered yet, in the order of the stream
        self.transmissions = self.lost = 0
        self._start_ns = self._arrival_ns = self._wakes_ns = 0

    def _has_more(self) -> bool:
        """Return whether a new segment may be sent."""
        raise NotImplementedError

    def _next_segment(self) -> Segment:
        """Return the next new segment."""
        raise NotImplementedError

    def _repairs(self, segment: Segment) -> tuple[int, int]:
        """Return kind and counter of a segment that is sent again."""
        raise NotImplementedError

    def _take(self, segments: list[Segment], now_ns: int) -> None:
        """Take the segments that follow those before, at least one."""
        raise NotImplementedError

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
            if self._again:
                self._send(self._again.popleft(), now_ns)
            else:
                segment = self._next_segment()
                self._order.append(segment)
                self._send(segment, now_ns)

    def _send(self, segment: Segment, now_ns: int) -> None:
        self.transmissions += 1
        attempt = segment.attempt
        kind, counter = segment.kind, segment.counter
        if attempt > 1:
            kind, counter = self._repairs(segment)
        arrival_ns = self._way.cross(self._epoch, counter, kind, segment.size, now_ns)
        if arrival_ns is not None:  # a segment overtakes no other one of its connection
            self._arrival_ns = max(self._arrival_ns, arrival_ns)
            self._agenda.put(self._arrive, (self._arrival_ns,), (segment, self.transmissions))
            return
        self.lost += 1
        self._missing.append((self.transmissions, segment, attempt))
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
        segments = list[Segment]()
        while self._order and self._order[0].arrived:
            segments.append(self._order.popleft())
        if segments:
            self._take(segments, now_ns)

    def _repair(self, segment: Segment, attempt: int, now_ns: int) -> None:
        """Send a lost segment again, unless it has been."""
        if segment.attempt == attempt:
            segment.attempt += 1
            self._again.append(segment)
            self._pump(now_ns)


class LinkStream(RepairedStream):
    """One direction of a TCP connection: bytes enter by `write`, and leave by `deliver`."""

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
        super().__init__(agenda, way, connection)
        self._deliver = deliver
        self._unsent, self._ending, self._ended = bytearray(), False, False
        self._count = 0  # segments
        self._bytes = 0  # sent, and not taken by the receiver
        self._start_ns = NOTHING_NS

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

    def _has_more(self) -> bool:
        """Return whether a new segment may be sent, or the end of the stream."""
        waits = bool(self._unsent) or (self._ending and not self._ended)
        return waits and self._bytes < WINDOW_BYTES

    def _next_segment(self) -> Segment:
        data = bytes(self._unsent[:SEGMENT])
        del self._unsent[:SEGMENT]
        segment = Segment(data, len(data), KIND + 1, self._count)
        self._count += 1
        self._bytes += segment.size
        self._ended = not data
        return segment

    def _repairs(self, segment: Segment) -> tuple[int, int]:
        return KIND + segment.attempt, segment.counter

    def _take(self, segments: list[Segment], now_ns: int) -> None:
        if whole := b"".join(segment.data for segment in segments):
            self._deliver(whole, now_ns)
        if not segments[-1].data:
            self._deliver(b"", now_ns)


class MessageStream(RepairedStream):
    """Messages of one direction, in order and all of them, as over gRPC or a websocket."""

    def __init__(
        self,
        agenda: PacketQueue,
        way: tuple[Medium, Medium],
        epoch: int,
        cut: Cut,
        deliver: Callable[[Any, int], None],
    ) -> None:
        """Make a stream; `deliver` gets the data of each message that is whole, and the time."""
        super().__init__(agenda, way, epoch)
        self._cut, self._deliver = cut, deliver
        self._unsent = deque[tuple[int, int, Any]]()  # number, size and data of messages
        self._place = 0  # of the next piece, in the first of them

    def send(self, number: int, size: int, data: Any, now_ns: int) -> None:
        """Send a message of `size` bytes."""
        self._unsent.append((number, size, data))
        self._pump(now_ns)

    def _has_more(self) -> bool:
        return bool(self._unsent)

    def _next_segment(self) -> Segment:
        number, size, data = self._unsent[0]
        kind, counter, length = self._cut.piece(number, size, self._place)
        self._place += 1
        if self._place < self._cut.count(size):
            return Segment(None, length, kind, counter)
        self._place = 0
        self._unsent.popleft()
        return Segment((data,), length, kind, counter)  # the last piece brings the message

    def _repairs(self, segment: Segment) -> tuple[int, int]:
        beyond = _BEYOND if segment.kind != KIND else 0
        return REPAIR + segment.attempt, segment.counter + beyond

    def _take(self, segments: list[Segment], now_ns: int) -> None:
        for segment in segments:
            if segment.data:
                (message,) = segment.data
                self._deliver(message, now_ns)
