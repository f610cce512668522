"""Carry one direction of a TCP connection over the link as Linux does, without sockets.

A lost segment is repaired after one round trip if later ones arrive, else after a probe or a
time-out.

Source: RFC 8985 (RACK and TLP), RFC 6298 with Linux' minimum of 200 ms.
Deviation: acknowledgements are neither delayed nor lost; the window grows by their number.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from math import ceil

from cloudrc.link.relay_tcp.agenda import Agenda
from cloudrc.link.relay_tcp.congestion import Congestion, SentSegment
from cloudrc.link.relay_tcp.medium import SEGMENT, Medium

WINDOW_BYTES = 3 << 20  # most bytes that are sent and that the receiver has not taken [bytes]
READ_AHEAD = 256 << 10  # most bytes that wait to be sent [bytes]
RETRY_MIN_NS = 200_000_000  # shortest time until a segment without an answer is sent again [ns]
PROBE_NS = 2_000_000  # added to two round trips until a probe [ns]


class Segment:
    """Some bytes of the stream; `data` is empty for the end of the stream."""

    __slots__ = ("acked", "arrived", "attempts", "data", "number", "place", "sent")

    def __init__(self, data: bytes, number: int, place: int) -> None:
        self.data, self.number, self.place = data, number, place
        self.attempts, self.sent = 0, SentSegment(0, 0, limited=True)
        self.arrived = self.acked = False


class LinkStream:
    """One direction of a connection: bytes enter by `write`, and leave by the call `deliver`.

    All times are on the clock of the agenda [ns].
    """

    def __init__(
        self,
        agenda: Agenda,
        way: tuple[Medium, Medium],
        connection: int,
        start_ns: int,
        deliver: Callable[[bytes, int], None],
        congestion: Congestion,
    ) -> None:
        """Make an empty stream, which sends nothing before `start_ns`.

        `way` is the direction of the bytes and that of the acknowledgements. `deliver` gets the
        bytes and the time; b"" is the end of the stream.
        `congestion` is that of this stream alone.
        """
        self._agenda, self._deliver, self._connection = agenda, deliver, connection
        self._way, self._back = way
        self._start_ns, self._waits = start_ns, False
        self.held = 0  # bytes that the receiver has not taken [bytes]
        self._unsent, self._ended, self._offset, self._count = bytearray(), False, 0, 0
        self._flight = deque[Segment]()  # in the order of sending, without holes found
        self._order = deque[Segment]()  # not delivered yet, in the order of the bytes
        self._holes = dict[int, Segment]()  # segments that later ones have overtaken
        # Number of the draw for the last segment; number and offset where the present burst began.
        self._place, self._first_place, self._first_offset = -1, 0, 0
        self._crossing = self._bytes = 0  # segments and bytes on their way
        self._arrival_ns = self._answer_ns = 0
        self._congestion, self._delivered, self._next_ns = congestion, 0, 0.0
        self._most = 0  # segments on their way at most since the stream was idle
        self._recovery = -1  # number of the last segment of which a loss shrinks the window no more
        self._trip_ns, self._spread_ns, self._round = 0, 0, -1
        self._deadline_ns, self._timer, self._probed, self._retries = 0, False, False, 0
        self._sent_ns = 0

    @property
    def room(self) -> int:
        """Number of bytes that the stream accepts now."""
        return 0 if self._ended else max(0, READ_AHEAD - len(self._unsent))

    def write(self, data: bytes, now_ns: int) -> None:
        """Send bytes; b"" ends the stream."""
        self._unsent += data
        self._ended |= not data
        self._pump(now_ns)

    def taken(self, count: int, now_ns: int) -> None:
        """Note that the receiver has taken bytes, so that more may be sent."""
        self.held -= count
        self._pump(now_ns)

    def _pump(self, now_ns: int) -> None:
        """Send what the window allows."""
        if now_ns < self._start_ns:
            self._next_ns = float(self._start_ns)
            self._pace()
            return
        if self._is_at_once(now_ns):
            return
        if not self._flight and not self._holes:
            self._restart(now_ns)
        while self._crossing < self._congestion.window and self._bytes + self.held < WINDOW_BYTES:
            if self._next_ns > now_ns and (self._unsent or self._ended):
                self._pace()
                return
            if self._unsent:
                data = bytes(self._unsent[:SEGMENT])
                del self._unsent[:SEGMENT]
            elif self._ended and self._offset >= 0:
                data = b""
            else:
                return
            self._place = self._first_place + (self._offset - self._first_offset) // SEGMENT
            segment = Segment(data, self._count, self._place)
            self._offset = self._offset + len(data) if data else -1
            self._count += 1
            self._bytes += len(data)
            self._order.append(segment)
            self._send(segment, now_ns)

    def _is_at_once(self, now_ns: int) -> bool:
        """Deliver all bytes at once, if the link is perfect and nothing is on its way."""
        perfect = self._way.is_perfect(now_ns) and self._back.is_perfect(now_ns)
        if not perfect or self._order:
            return False
        while self._unsent and self.held < WINDOW_BYTES:
            data = bytes(self._unsent)
            self._unsent.clear()
            self._offset += len(data)
            self.held += len(data)
            self._deliver(data, now_ns)
        if self._ended and not self._unsent and self._offset >= 0:
            self._offset = -1
            self._deliver(b"", now_ns)
        return True

    def _restart(self, now_ns: int) -> None:
        """Shrink the window after a pause, as it may not fit the link any more."""
        self._most = 0
        self._first_place, self._first_offset = self._place + 1, self._offset
        if self._sent_ns:
            self._congestion.rested((now_ns - self._sent_ns) / self._retry_ns())

    def _pace(self) -> None:
        """Send on when the congestion control allows the next segment."""
        if not self._waits:
            self._waits = True
            self._agenda.at(ceil(self._next_ns), self._resume)

    def _resume(self, now_ns: int) -> None:
        self._waits = False
        self._pump(now_ns)

    def _send(self, segment: Segment, now_ns: int) -> None:
        segment.attempts += 1
        segment.sent = SentSegment(now_ns, self._delivered, limited=not self._unsent)
        self._sent_ns = now_ns
        self._next_ns = max(self._next_ns, float(now_ns)) + self._congestion.spacing_ns()
        self._flight.append(segment)
        self._crossing += 1
        self._most = max(self._most, self._crossing)
        size = len(segment.data)
        arrival_ns = self._way.cross(
            self._connection, segment.place, segment.attempts, size, now_ns
        )
        if arrival_ns is not None:  # a segment overtakes no other one
            self._arrival_ns = max(self._arrival_ns, arrival_ns)
            self._agenda.at(self._arrival_ns, self._arrive, segment, segment.attempts)
        self._arm(now_ns)

    def _arrive(self, segment: Segment, attempt: int, now_ns: int) -> None:
        """Deliver a segment at the far end, and acknowledge it."""
        self._answer_ns = max(self._answer_ns, now_ns + self._back.delay_ns(now_ns))
        self._agenda.at(self._answer_ns, self._take_answer, segment, attempt)
        if segment.arrived:
            return
        segment.arrived = True
        parts, ends = [], False
        while self._order and self._order[0].arrived:
            data = self._order.popleft().data
            parts.append(data)
            ends |= not data
        if whole := b"".join(parts):
            self.held += len(whole)
            self._bytes -= len(whole)
            self._deliver(whole, now_ns)
        if ends:
            self._deliver(b"", now_ns)

    def _take_answer(self, segment: Segment, attempt: int, now_ns: int) -> None:
        """Take the acknowledgement of a transmission of a segment."""
        if segment.acked:
            return
        segment.acked = True
        if segment.number not in self._holes:
            self._crossing -= 1
        self._holes.pop(segment.number, None)
        self._delivered += 1
        if segment.attempts == attempt:
            self._measure(now_ns - segment.sent.sent_ns)
            self._find_holes(segment, now_ns)
        self._probed, self._retries = False, 0
        if segment.number > self._round:
            self._round, segment.sent.new_round = self._count - 1, True
        segment.sent.rate_of = self._delivered - segment.sent.delivered
        segment.sent.recovers = segment.number <= self._recovery
        if segment.attempts == attempt:
            self._congestion.acknowledged(segment.sent, now_ns, self._most)
        self._arm(now_ns)
        self._pump(now_ns)

    def _find_holes(self, segment: Segment, now_ns: int) -> None:
        """Find the segments that were sent before an acknowledged one: they are lost."""
        flight = self._flight
        while flight and flight[0] is not segment:
            older = flight.popleft()
            if not older.acked:
                self._holes[older.number] = older
                self._crossing -= 1
                # Linux waits until three later ones have arrived, at most a quarter of a trip.
                wait_ns = 0 if len(flight) >= 3 else self._trip_ns // 4
                self._agenda.at(now_ns + wait_ns, self._repair, older, older.attempts)
        if flight:
            flight.popleft()

    def _repair(self, segment: Segment, attempt: int, now_ns: int) -> None:
        """Send a lost segment again; the first loss of a window shrinks the window."""
        if segment.acked or segment.attempts != attempt:
            return
        self._holes.pop(segment.number, None)
        if segment.number > self._recovery:
            self._recovery = self._count - 1
            self._congestion.lost(now_ns)
        self._send(segment, now_ns)

    def _measure(self, trip_ns: int) -> None:
        """Update the round trip and its spread with one sample."""
        if not self._trip_ns:
            self._trip_ns, self._spread_ns = trip_ns, trip_ns // 2
        self._spread_ns += (abs(trip_ns - self._trip_ns) - self._spread_ns) // 4
        self._trip_ns += (trip_ns - self._trip_ns) // 8

    def _retry_ns(self) -> int:
        if not self._trip_ns:
            return 1_000_000_000
        return self._trip_ns + max(RETRY_MIN_NS, 4 * self._spread_ns)

    def _arm(self, now_ns: int) -> None:
        """Set the time at which a probe or a time-out is due."""
        wait_ns = self._retry_ns() << self._retries
        if self._trip_ns and not self._probed and not self._retries:
            alone = RETRY_MIN_NS if len(self._flight) == 1 else PROBE_NS
            wait_ns = min(wait_ns, 2 * self._trip_ns + alone)
        self._deadline_ns = now_ns + wait_ns
        if not self._timer:
            self._timer = True
            self._agenda.at(self._deadline_ns, self._look)

    def _look(self, now_ns: int) -> None:
        """Send a probe or try again, if the deadline has come and segments have no answer."""
        self._timer = False
        waiting = [one for one in self._flight if not one.acked]
        if not waiting:
            return
        if now_ns < self._deadline_ns:
            self._timer = True
            self._agenda.at(self._deadline_ns, self._look)
            return
        if self._trip_ns and not self._probed and not self._retries:
            self._probed = True
            self._crossing -= 1
            self._flight.remove(waiting[-1])
            self._send(waiting[-1], now_ns)
            return
        self._retries = min(self._retries + 1, 8)
        self._congestion.timed_out(now_ns)
        self._recovery = self._count - 1
        self._flight.clear()
        self._crossing = 0
        for segment in waiting:
            self._send(segment, now_ns)
