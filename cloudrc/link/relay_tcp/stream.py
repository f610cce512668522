"""Carry one direction of a TCP connection over the link as Linux does, without sockets.

A lost segment is repaired after one round trip if later ones arrive, else after a probe or a
time-out.

Source: RFC 8985 (RACK and TLP), RFC 6298 with Linux' minimum of 200 ms.
Deviation: acknowledgements are not lost; a shrunk window is used at once, without PRR (RFC 6937).
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable

from cloudrc.link.queue import NOTHING_NS
from cloudrc.link.relay_tcp.agenda import Agenda
from cloudrc.link.relay_tcp.congestion import Cubic, SentSegment
from cloudrc.link.relay_tcp.medium import SEGMENT, Medium
from cloudrc.link.relay_tcp.receiver import Receiver, Segment, Transmission

WINDOW_BYTES = 3 << 20  # most bytes that are sent and that the receiver has not taken [bytes]
READ_AHEAD = 256 << 10  # most bytes that wait to be sent [bytes]
FIRST_OFFER = 45  # segments for which a new receiver has room: 64 KiB; it grows by round trips
RETRY_MIN_NS = 200_000_000  # shortest time until a segment without an answer is sent again [ns]
PROBE_NS = 2_000_000  # added to two round trips until a probe [ns]


class LinkStream:
    """One direction of a connection: bytes enter by `write`, and leave by the call `deliver`.

    All times are on the clock of the agenda [ns].
    """

    def __init__(
        self,
        agenda: Agenda,
        way: tuple[Medium, Medium],
        connection: int,
        deliver: Callable[[bytes, int], None],
    ) -> None:
        """Make an empty stream, which sends nothing before `open`.

        `way` is the direction of the bytes and that of the acknowledgements. `deliver` gets the
        bytes and the time; b"" is the end of the stream.
        """
        self._agenda, self._connection, self._congestion = agenda, connection, Cubic()
        self._way, self._back = way
        self._deliver = deliver
        self._far = Receiver(agenda, self._back, deliver, self._take_answer)
        self._unsent, self._ended, self._offset, self._count = bytearray(), False, 0, 0
        self._waiting = deque[Segment]()  # for an acknowledgement, in the order of the bytes
        self._flight = deque[Segment]()  # on their way, in the order of sending
        self._lost = deque[Segment]()  # to be sent again
        # Number of the draw for the last segment; number and offset where the present burst began.
        self._place, self._first_place, self._first_offset = -1, 0, 0
        self._crossing = self._bytes = 0  # segments on their way, and bytes sent and not taken
        self._most = 0  # segments on their way at most in this round trip
        self._delivered = 0  # segments acknowledged
        self._round = 0  # number of the first segment of the next round trip
        self._offered = FIRST_OFFER  # most segments that the receiver has room for
        self._recovery, self._recovers = -1, False  # last segment of the window with a loss
        self._start_ns = NOTHING_NS
        self._arrival_ns = self._sent_ns = 0
        self._trip_ns = self._spread_ns = 0
        self._deadline_ns, self._look_ns, self._probed, self._retries = 0, NOTHING_NS, False, 0

    @property
    def room(self) -> int:
        """Number of bytes that the stream accepts now."""
        return 0 if self._ended else max(0, READ_AHEAD - len(self._unsent))

    def open(self, start_ns: int, trip_ns: int) -> None:
        """Send from the time `start_ns` on [ns]; `trip_ns` is the first round trip's time [ns]."""
        self._start_ns = start_ns
        self._measure(trip_ns)
        self._agenda.at(start_ns, self._pump)

    def write(self, data: bytes, now_ns: int) -> None:
        """Send bytes; b"" ends the stream."""
        self._unsent += data
        self._ended |= not data
        self._pump(now_ns)

    def taken(self, count: int, now_ns: int) -> None:
        """Note that the receiver has taken bytes, so that more may be sent."""
        self._bytes -= count
        self._pump(now_ns)

    def _pump(self, now_ns: int) -> None:
        """Send what the window allows, lost segments first."""
        if now_ns < self._start_ns or self._is_at_once(now_ns):
            return
        if not self._waiting:
            self._restart(now_ns)
        while self._crossing + 1 <= self._congestion.window and (self._lost or self._has_more()):
            segment = self._lost.popleft() if self._lost else self._next_segment()
            if not (segment.acked or segment.crossing):
                self._send(segment, now_ns)

    def _has_more(self) -> bool:
        """Return whether a new segment may be sent, or the end of the stream."""
        waits = bool(self._unsent) or (self._ended and self._offset >= 0)
        return waits and self._bytes < WINDOW_BYTES and len(self._waiting) < self._offered

    def _next_segment(self) -> Segment:
        data = bytes(self._unsent[:SEGMENT])
        del self._unsent[:SEGMENT]
        self._place = self._first_place + (self._offset - self._first_offset) // SEGMENT
        segment = Segment(data, self._count, self._place)
        self._offset = self._offset + len(data) if data else -1
        self._count += 1
        self._bytes += len(data)
        self._waiting.append(segment)
        self._far.expect(segment)
        return segment

    def _is_at_once(self, now_ns: int) -> bool:
        """Deliver all bytes at once, if the link is perfect and nothing is on its way."""
        perfect = self._way.is_perfect(now_ns) and self._back.is_perfect(now_ns)
        if not perfect or self._waiting:
            return False
        while self._unsent and self._bytes < WINDOW_BYTES:
            data = bytes(self._unsent)
            self._unsent.clear()
            self._offset += len(data)
            self._bytes += len(data)
            self._deliver(data, now_ns)
        if self._ended and not self._unsent and self._offset >= 0:
            self._offset = -1
            self._deliver(b"", now_ns)
        return True

    def _restart(self, now_ns: int) -> None:
        """Begin a burst of segments after a pause."""
        self._most = 0
        self._first_place, self._first_offset = self._place + 1, self._offset
        if self._sent_ns:
            self._congestion.rested(now_ns - self._sent_ns, self._retry_ns())

    def _send(self, segment: Segment, now_ns: int) -> None:
        segment.attempts += 1
        segment.sent = SentSegment(now_ns)
        self._sent_ns = now_ns
        self._flight.append(segment)
        segment.crossing = True
        self._crossing += 1
        self._most = max(self._most, self._crossing)
        size = len(segment.data)
        arrival_ns = self._way.cross(
            self._connection, segment.place, segment.attempts, size, now_ns
        )
        if arrival_ns is not None:  # a segment overtakes no other one
            self._arrival_ns = max(self._arrival_ns, arrival_ns)
            self._far.await_arrival(segment, self._arrival_ns)
        if segment is self._waiting[0] or not self._recovers:
            self._arm(now_ns)

    def _take_answer(self, answered: list[Transmission], now_ns: int) -> None:
        """Take an acknowledgement of one or more transmissions."""
        fresh = [one for one in answered if not one[0].acked]
        if not fresh:
            return
        for segment, _ in fresh:
            segment.acked = True
            self._leave(segment)
        self._delivered += len(fresh)
        segment, attempt = fresh[-1]
        is_known = segment.attempts == attempt  # which transmission the answer belongs to
        if is_known:
            self._measure(now_ns - segment.sent.sent_ns)
            self._find_losses(segment, now_ns)
        if self._probed and attempt > 1 and segment.number > self._recovery:
            self._shrink(now_ns)  # the probe has repaired the loss
        self._probed, self._retries = False, 0
        advances = self._waiting[0].acked
        while self._waiting and self._waiting[0].acked:
            self._waiting.popleft()
        self._recovers = self._recovers and self._first() <= self._recovery
        if self._first() > self._round:
            self._round, segment.sent.new_round = self._count, True
        segment.sent.recovers = self._recovers
        if is_known:
            self._congestion.acknowledged(segment.sent, len(fresh), now_ns, self._most)
        if segment.sent.new_round:
            self._most = self._crossing
            self._offered = FIRST_OFFER + self._delivered
        if advances:
            self._arm(now_ns)
        self._pump(now_ns)

    def _first(self) -> int:
        """Return the number of the first segment that is not acknowledged."""
        return self._waiting[0].number if self._waiting else self._count

    def _leave(self, segment: Segment) -> None:
        """Note that a segment is not on its way any more."""
        self._crossing -= segment.crossing
        segment.crossing = False

    def _find_losses(self, segment: Segment, now_ns: int) -> None:
        """Find the segments that were sent before an acknowledged one: they are lost."""
        flight = self._flight
        while flight and flight[0].sent.sent_ns <= segment.sent.sent_ns:
            older = flight.popleft()
            if older is segment:
                return
            if not older.acked:
                # Linux waits until three later ones have arrived, at most a quarter of a trip.
                if len(flight) >= 3 or self._recovers:
                    self._repair(older, older.attempts, now_ns)
                else:
                    wait_ns = self._trip_ns // 4
                    self._agenda.at(now_ns + wait_ns, self._repair, older, older.attempts)

    def _repair(self, segment: Segment, attempt: int, now_ns: int) -> None:
        """Send a lost segment again; the first loss of a window shrinks the window."""
        if segment.acked or segment.attempts != attempt or not segment.crossing:
            return
        self._leave(segment)
        if segment.number > self._recovery:
            self._shrink(now_ns)
            self._send(segment, now_ns)
        else:
            self._lost.append(segment)
            self._pump(now_ns)

    def _shrink(self, now_ns: int) -> None:
        self._recovery, self._recovers = self._count - 1, True
        self._congestion.lost(now_ns)

    def _measure(self, trip_ns: int) -> None:
        """Update the round trip and its spread with one sample."""
        if not self._trip_ns:
            self._trip_ns, self._spread_ns = trip_ns, trip_ns // 2
        self._spread_ns += (abs(trip_ns - self._trip_ns) - self._spread_ns) // 4
        self._trip_ns += (trip_ns - self._trip_ns) // 8

    def _retry_ns(self) -> int:
        return self._trip_ns + max(RETRY_MIN_NS, 4 * self._spread_ns)

    def _arm(self, now_ns: int) -> None:
        """Set the time at which a probe or a time-out is due."""
        wait_ns = self._retry_ns() << self._retries
        if self._may_probe():
            alone = RETRY_MIN_NS if len(self._waiting) == 1 else PROBE_NS
            wait_ns = min(wait_ns, 2 * self._trip_ns + alone)
        self._deadline_ns = now_ns + wait_ns
        self._await_deadline()

    def _await_deadline(self) -> None:
        if self._deadline_ns < self._look_ns:
            self._look_ns = self._deadline_ns
            self._agenda.at(self._look_ns, self._look)

    def _may_probe(self) -> bool:
        return not (self._probed or self._retries or self._recovers)

    def _look(self, now_ns: int) -> None:
        """Send a probe or try again, if the deadline has come and segments have no answer."""
        if now_ns != self._look_ns:  # another look has come before
            return
        self._look_ns = NOTHING_NS
        if not self._waiting:
            return
        if now_ns < self._deadline_ns:
            self._await_deadline()
            return
        if self._may_probe():
            self._probed = True
            last = self._waiting[-1]
            self._leave(last)
            if last in self._flight:
                self._flight.remove(last)
            self._send(last, now_ns)
            return
        self._time_out(now_ns)

    def _time_out(self, now_ns: int) -> None:
        """Count all segments without an answer as lost, and begin again."""
        self._retries = min(self._retries + 1, 8)
        self._congestion.timed_out(now_ns)
        self._recovery, self._recovers = self._count - 1, False
        self._flight.clear()
        self._lost = deque(segment for segment in self._waiting if not segment.acked)
        for segment in self._lost:
            self._leave(segment)
        self._arm(now_ns)
        self._pump(now_ns)
