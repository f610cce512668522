"""One way through the link in real time: from one UDP socket, through the model, to another.

The relay of local mode has two lanes, the relay of a pod's sidecar one. A datagram is due when the
kernel received it plus the delay that the model draws, however long it waited for this process, and
never leaves before.
"""

from __future__ import annotations

import heapq
import socket
from collections.abc import Callable, Sequence
from itertools import count
from time import monotonic_ns
from typing import TypeAlias

from cloudrc.link.model import LinkDirection
from cloudrc.link.relay_batch import Received, Receiver, Sender, available
from cloudrc.link.relay_errors import ReleaseErrors, in_ns
from cloudrc.link.relay_stamps import (
    AGE_MAX_NS,
    ANCILLARY_SIZE,
    Stamps,
    ask_for_stamps,
    instant_ns,
)

Address: TypeAlias = tuple[str, int]
Peek: TypeAlias = Callable[[bytes], tuple[int, int, int]]
"""Kind, epoch and counter of a datagram; raises ValueError if it is not one of ours."""

IN_FLIGHT_MAX = 10_000
"""Datagrams that a lane holds at once, unless told otherwise."""
DATAGRAM_MAX = 2_048
"""Longer ones are malformed, so that what a lane holds is bounded in bytes, too."""

_FEW = 4
"""Datagrams that are read one by one, where they cannot be read with one call."""
_BATCH = 32
"""Datagrams taken in or released with one call."""
_TOO_LONG = int(socket.MSG_TRUNC)
_ROUNDS = 3
"""Batches taken in or released on one side before the other has its turn."""


class Side:
    """One side of a lane: its socket, which stays its owner's to close, and who is there.

    Attributes:
        stamped: Whether the kernel notes when a datagram came, so that it may wait to be read.
    """

    def __init__(self, own: socket.socket, peer: Address | None = None) -> None:
        own.setblocking(False)
        self.stamped = ask_for_stamps(own)
        self.socket = own
        self.peer = peer
        batches = available()
        self.receiver = Receiver(own, _BATCH, DATAGRAM_MAX) if batches else None
        self.sender = Sender(own, _BATCH, DATAGRAM_MAX) if batches else None


class Lane:
    """Takes datagrams in at one side, asks the model, and sends them from the other when due.

    Attributes:
        origin_ns: What the model counts time from [ns], monotonic clock; None: from the first
            datagram.
        errors: How late datagrams have left.
    """

    def __init__(
        self,
        source: Side,
        target: Side,
        direction: LinkDirection,
        peek: Peek,
        in_flight_max: int = IN_FLIGHT_MAX,
    ) -> None:
        """Set up.

        Args:
            source: Where datagrams arrive; its peer, if unknown, is whom the first valid one is
                from.
            target: Where they leave for `target.peer`, which may change in flight.
            direction: The link between the two.
            peek: Reads kind, epoch and counter of a datagram.
            in_flight_max: Datagrams held at once; what comes on top is dropped and counted.
        """
        self.source = source
        self.target = target
        self.direction = direction
        self.origin_ns: int | None = None
        self.errors = ReleaseErrors()
        self._peek = peek
        self._in_flight_max = in_flight_max
        # Due instant [ns], a number that keeps equal instants in order, data.
        self._in_flight: list[tuple[int, int, bytes]] = []
        self._numbers = count()
        self._stamps = Stamps()
        self._received = self._forwarded = self._lost = 0
        self._malformed = self._overflow = self._unsent = self._stalled = 0

    def due_ns(self) -> int | None:
        """Say when the next datagram is to leave [ns], monotonic clock; None if none is held."""
        return self._in_flight[0][0] if self._in_flight else None

    @property
    def patience_ns(self) -> int:
        """For so long at most a datagram waits for this lane until it has to be due [ns]."""
        return self.direction.least_delay_ns if self.source.stamped else 0

    def take_in(self) -> int:
        """Put what waits in the source's socket on the link; say how many datagrams that were."""
        offset_ns = self._stamps.look_at_clocks()
        receiver, taken = self.source.receiver, 0
        if receiver is None or self.source.peer is None:
            few = self._read_few()
            self._put_on_link(few, offset_ns)
            return len(few)
        for _ in range(_ROUNDS):
            batch = receiver.receive()
            self._put_on_link(batch, offset_ns)
            taken += len(batch)
            if len(batch) < _BATCH:
                break
        return taken

    def release(self) -> None:
        """Send what is due."""
        in_flight, target, now_ns = self._in_flight, self.target, monotonic_ns()
        for _ in range(_ROUNDS):
            if not in_flight or in_flight[0][0] > now_ns:
                return
            due_ns, _, data = heapq.heappop(in_flight)
            self._send(due_ns, data, now_ns)
            if target.sender and target.peer and in_flight and in_flight[0][0] <= now_ns:
                self._release_batch(target.sender, target.peer, now_ns)
            now_ns = monotonic_ns()

    def counts(self) -> dict[str, int]:
        """Say what has happened to datagrams so far; `Lanes.outcomes` explains the names."""
        return {
            "received": self._received,
            "forwarded": self._forwarded,
            "lost": self._lost,
            "malformed": self._malformed,
            "overflow": self._overflow,
            "unread": self._stamps.dropped,
            "unsent": self._unsent,
        }

    def released(self) -> dict[str, int]:
        """Say how late datagrams left since the beginning, and what the errors do not tell.

        As `relay_errors.in_ns`; `overflow`: how many had no room here; `stalled`: how many waited
        for this process for 50 ms or more, and may have waited for longer than is known: they left
        later than their errors say. Empty before the first. Any thread may ask.
        """
        told = in_ns(self.errors)
        return {**told, "overflow": self._overflow, "stalled": self._stalled} if told else {}

    def _read_few(self) -> list[Received]:
        """Read what waits, one by one and not for long."""
        read, source, found = self._stamps.wall_ns, self.source, list[Received]()
        for _ in range(_FEW):
            try:
                data, beside, flags, address = source.socket.recvmsg(DATAGRAM_MAX, ANCILLARY_SIZE)
            except OSError:  # Nothing left, or the kernel reports that a peer is not there yet.
                break
            whole = not flags & _TOO_LONG
            found.append((data if whole else None, read(beside), None))
            if source.peer is None and whole and self._is_ours(data):
                source.peer = address
        return found

    def _put_on_link(self, batch: Sequence[Received], offset_ns: int | None) -> None:
        """Draw what becomes of datagrams, and hold what is to leave."""
        now_ns, peek, direction = monotonic_ns(), self._peek, self.direction
        in_flight, numbers, push = self._in_flight, self._numbers, heapq.heappush
        self._received += len(batch)
        for data, wall_ns, dropped in batch:
            if dropped is not None:
                self._stamps.learn_dropped(dropped)
            try:
                if data is None:
                    raise ValueError
                kind, epoch, counter = peek(data)
            except ValueError:
                self._malformed += 1
                continue
            received_ns = instant_ns(wall_ns, offset_ns, now_ns)
            if now_ns - received_ns >= AGE_MAX_NS:
                self._stalled += 1
            origin_ns = self.origin_ns
            if origin_ns is None:
                origin_ns = self.origin_ns = received_ns
            size = len(data)
            releases = direction.send(epoch, kind, counter, size, received_ns - origin_ns)
            if not releases:
                self._lost += 1
            elif direction.corrupts:
                data = direction.corrupted(epoch, kind, counter, data)
            for release_ns in releases:
                if len(in_flight) >= self._in_flight_max:
                    self._overflow += 1
                else:
                    push(in_flight, (release_ns + origin_ns, next(numbers), data))

    def _is_ours(self, data: bytes) -> bool:
        try:
            self._peek(data)
        except ValueError:
            return False
        return True

    def _release_batch(self, sender: Sender, peer: Address, now_ns: int) -> None:
        """Send with one call what else is due at `now_ns`."""
        in_flight = self._in_flight
        batch: list[tuple[int, int, bytes]] = []
        while in_flight and in_flight[0][0] <= now_ns and len(batch) < _BATCH:
            batch.append(heapq.heappop(in_flight))
        begun_ns = monotonic_ns()
        sent = sender.send([data for _, _, data in batch], peer)
        self._forwarded += sent
        # The kernel takes equally long for each.
        each_ns, observe = (monotonic_ns() - begun_ns) // max(sent, 1), self.errors.observe
        for due_ns, _, _ in batch[:sent]:
            observe(begun_ns - due_ns)
            begun_ns += each_ns
        for due_ns, _, data in batch[sent:]:
            self._send(due_ns, data, monotonic_ns())

    def _send(self, due_ns: int, data: bytes, now_ns: int) -> None:
        """Send one that is due at `now_ns`."""
        target = self.target
        try:
            if target.peer is None:
                raise OSError
            target.socket.sendto(data, target.peer)
        except OSError:
            self._unsent += 1
        else:
            self._forwarded += 1
            self.errors.observe(now_ns - due_ns)
