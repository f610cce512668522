"""One way through the link in real time: from one UDP socket, through the model, to another.

The relay of local mode has two lanes, the relay of a pod's sidecar one. A datagram never leaves
early: `Lanes` sleeps in `select`, whose timeout is exact to the kernel's timer slack (about 50 us;
epoll's would be rounded up to 1 ms), and looks at the clock again before it sends.
"""

from __future__ import annotations

import heapq
import select
import socket
import time
from collections import Counter, deque
from collections.abc import Callable, Sequence
from itertools import count
from typing import TypeAlias

from cloudrc.link.model import LinkDirection

Address: TypeAlias = tuple[str, int]
Peek: TypeAlias = Callable[[bytes], tuple[int, int, int]]
"""Kind, epoch and counter of a datagram; raises ValueError if it is not one of ours."""

IN_FLIGHT_MAX = 10_000
"""Datagrams that a lane holds at once, unless told otherwise."""

_DATAGRAM_MAX = 65_535
_DRAIN_MAX = 64
"""Datagrams taken in from one side before releases have their turn."""
_ERRORS_KEPT = 10_000


class Side:
    """One side of a lane: its socket, which stays its owner's to close, and who is there."""

    def __init__(self, own: socket.socket, peer: Address | None = None) -> None:
        own.setblocking(False)
        self.socket = own
        self.peer = peer


class Lane:
    """Takes datagrams in at one side, asks the model, and sends them from the other when due."""

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
        self._peek = peek
        self._in_flight_max = in_flight_max
        # Due instant [ns], a number that keeps equal instants in order, data.
        self._in_flight: list[tuple[int, int, bytes]] = []
        self._numbers = count()
        self.errors_ns: deque[int] = deque(maxlen=_ERRORS_KEPT)
        self._received = self._forwarded = self._lost = 0
        self._malformed = self._overflow = self._unsent = 0

    def due_ns(self) -> int | None:
        """Say when the next datagram is to leave [ns]; None if none is held."""
        return self._in_flight[0][0] if self._in_flight else None

    def take_in(self, now: Callable[[], int]) -> None:
        """Put what waits in the source's socket on the link."""
        for _ in range(_DRAIN_MAX):
            try:
                data, address = self.source.socket.recvfrom(_DATAGRAM_MAX)
            except OSError:  # Nothing left, or the kernel reports that a peer is not there yet.
                return
            now_ns = now()
            self._received += 1
            try:
                kind, epoch, counter = self._peek(data)
            except ValueError:
                self._malformed += 1
                continue
            self.source.peer = self.source.peer or address
            releases = self.direction.send(epoch, kind, counter, len(data), now_ns)
            if not releases:
                self._lost += 1
            for release_ns in releases:
                if len(self._in_flight) >= self._in_flight_max:
                    self._overflow += 1
                else:
                    heapq.heappush(self._in_flight, (release_ns, next(self._numbers), data))

    def release(self, now: Callable[[], int]) -> None:
        """Send what is due."""
        in_flight, target = self._in_flight, self.target
        while in_flight and in_flight[0][0] <= (now_ns := now()):
            due_ns, _, data = heapq.heappop(in_flight)
            try:
                if target.peer is None:
                    raise OSError
                target.socket.sendto(data, target.peer)
            except OSError:
                self._unsent += 1
                continue
            self._forwarded += 1
            self.errors_ns.append(now_ns - due_ns)

    def counts(self) -> dict[str, int]:
        """Say what has happened to datagrams so far; `Lanes.outcomes` explains the names."""
        return {
            "received": self._received,
            "forwarded": self._forwarded,
            "lost": self._lost,
            "malformed": self._malformed,
            "overflow": self._overflow,
            "unsent": self._unsent,
        }


class Lanes:
    """Lanes that share one thread and one wait."""

    def __init__(self, lanes: Sequence[Lane], origin_ns: int | None) -> None:
        """Set up.

        Args:
            lanes: At least one.
            origin_ns: What their models count time from [ns], on the machine's monotonic clock;
                None: from the first datagram, as in virtual time, whatever it takes to start.
        """
        self._lanes = tuple(lanes)
        self._sockets = [lane.source.socket for lane in self._lanes]
        self._origin_ns = origin_ns

    def step(self, timeout: float) -> None:
        """Wait for a datagram or a due instant, at most `timeout` [s], and handle what is there."""
        for lane in self._lanes:
            due_ns = lane.due_ns()
            if due_ns is not None:
                timeout = min(timeout, max(0.0, (due_ns - self._now_ns()) * 1e-9))
        readable, _, _ = select.select(self._sockets, (), (), timeout)
        for lane in self._lanes:
            lane.release(self._now_ns)
        for lane in self._lanes:
            if lane.source.socket in readable:
                lane.take_in(self._now_ns)

    def outcomes(self) -> dict[str, int]:
        """Count the datagrams of all lanes by what became of them.

        `received`; `lost` on the link by any cause; `malformed`; `overflow` beyond
        `in_flight_max`; `unsent` because the other end is unknown or the kernel refused;
        `forwarded`, copies included.
        """
        outcomes: Counter[str] = Counter()
        for lane in self._lanes:
            outcomes.update(lane.counts())
        return outcomes

    def counts(self) -> dict[str, float]:
        """Say what has happened so far, on all lanes together.

        `outcomes`, and `release_error_p99`: how late the last 10,000 of each lane left [s]; absent
        before the first. Takes a millisecond: not for use in flight.
        """
        counts: dict[str, float] = dict(self.outcomes())
        errors_ns = sorted(error_ns for lane in self._lanes for error_ns in lane.errors_ns)
        if errors_ns:
            counts["release_error_p99"] = errors_ns[int(0.99 * (len(errors_ns) - 1))] * 1e-9
        return counts

    def _now_ns(self) -> int:
        if self._origin_ns is None:
            self._origin_ns = time.monotonic_ns()
        return time.monotonic_ns() - self._origin_ns
