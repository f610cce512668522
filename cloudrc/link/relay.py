"""The link in real time: datagrams come in on two UDP sockets and go out when the model says so.

    world <-> [world side]  Relay  [cloud side] <-> cloud

One thread, one heap. A datagram never leaves early: the relay sleeps in `select`, whose timeout is
exact to the kernel's timer slack (about 50 us; epoll's would be rounded up to 1 ms), and looks at
the clock again before it sends.
"""

from __future__ import annotations

import heapq
import select
import socket
import time
from collections import deque
from collections.abc import Callable
from itertools import count
from typing import TypeAlias

from cloudrc.link.model import LinkDirection

Address: TypeAlias = tuple[str, int]
Peek: TypeAlias = Callable[[bytes], tuple[int, int, int]]
"""Kind, epoch and counter of a datagram; raises ValueError if it is not one of ours."""

LOOPBACK = "127.0.0.1"

_DATAGRAM_MAX = 65_535
_DRAIN_MAX = 64
"""Datagrams taken in from one side before releases have their turn."""
_STOP_PERIOD = 0.1
"""How often `stop` is asked at least [s]."""
_ERRORS_KEPT = 10_000


def bind_loopback(port: int = 0) -> socket.socket:
    """Open a UDP socket on 127.0.0.1; port 0 lets the kernel choose."""
    bound = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    bound.bind((LOOPBACK, port))
    return bound


class _Side:
    """One side of the relay: its socket, who is there, and the link that leads away from it."""

    def __init__(self, own: socket.socket, peer: Address | None, direction: LinkDirection) -> None:
        own.setblocking(False)
        self.socket = own
        self.peer = peer
        self.direction = direction


class Relay:
    """Forwards datagrams between world and cloud through the two directions of a link."""

    def __init__(
        self,
        uplink: LinkDirection,
        downlink: LinkDirection,
        peek: Peek,
        *,
        world_side: socket.socket,
        cloud_side: socket.socket,
        world_peer: Address | None = None,
        cloud_peer: Address | None = None,
        in_flight_max: int = 10_000,
    ) -> None:
        """Set up; the sockets stay the caller's to close.

        Args:
            uplink: World to cloud. Its time begins with 0 at the first datagram, as in virtual
                time, whatever the processes take to start: leave its origin at 0.
            downlink: Cloud to world, likewise.
            peek: Reads kind, epoch and counter of a datagram.
            world_side: Bound UDP socket that world sends to.
            cloud_side: Bound UDP socket that cloud sends to.
            world_peer: Where world listens; None takes the source of its first valid datagram.
            cloud_peer: Where cloud listens; None likewise.
            in_flight_max: Datagrams held at once; what comes on top is dropped and counted.
        """
        self._world = _Side(world_side, world_peer, uplink)
        self._cloud = _Side(cloud_side, cloud_peer, downlink)
        self._peek = peek
        self._in_flight_max = in_flight_max
        # Due instant [ns], a number that keeps equal instants in order, data, where it goes.
        self._in_flight: list[tuple[int, int, bytes, _Side]] = []
        self._numbers = count()
        self._origin_ns: int | None = None
        self._errors_ns: deque[int] = deque(maxlen=_ERRORS_KEPT)
        self._received = self._forwarded = self._lost = 0
        self._malformed = self._overflow = self._unsent = 0

    def run(self, stop: Callable[[], bool]) -> None:
        """Forward until `stop` says True; it is asked at least every 0.1 s."""
        while not stop():
            self.step(_STOP_PERIOD)

    def step(self, timeout: float) -> None:
        """Wait for a datagram or a due instant, at most `timeout` [s], and handle what is there."""
        if self._in_flight:
            due_in = (self._in_flight[0][0] - self._now_ns()) * 1e-9
            timeout = min(timeout, max(0.0, due_in))
        readable, _, _ = select.select((self._world.socket, self._cloud.socket), (), (), timeout)
        self._release()
        if self._world.socket in readable:
            self._take_in(self._world, self._cloud)
        if self._cloud.socket in readable:
            self._take_in(self._cloud, self._world)

    def counts(self) -> dict[str, float]:
        """Say what has happened so far.

        Datagrams: `received`; `lost` on the link by any cause; `malformed`; `overflow` beyond
        `in_flight_max`; `unsent` because the other end is unknown or the kernel refused;
        `forwarded`, copies included. `release_error_p99` is how late the last 10,000 left [s];
        absent before the first.
        """
        counts: dict[str, float] = {
            "received": self._received,
            "forwarded": self._forwarded,
            "lost": self._lost,
            "malformed": self._malformed,
            "overflow": self._overflow,
            "unsent": self._unsent,
        }
        if self._errors_ns:
            errors_ns = sorted(self._errors_ns)
            counts["release_error_p99"] = errors_ns[int(0.99 * (len(errors_ns) - 1))] * 1e-9
        return counts

    def _now_ns(self) -> int:
        """Time since the link came up [ns]: since the first datagram."""
        if self._origin_ns is None:
            self._origin_ns = time.monotonic_ns()
        return time.monotonic_ns() - self._origin_ns

    def _take_in(self, source: _Side, target: _Side) -> None:
        """Put what waits in the socket of one side on the link to the other."""
        for _ in range(_DRAIN_MAX):
            try:
                data, address = source.socket.recvfrom(_DATAGRAM_MAX)
            except OSError:  # Nothing left, or the kernel reports that a peer is not there yet.
                return
            now_ns = self._now_ns()
            self._received += 1
            try:
                kind, epoch, counter = self._peek(data)
            except ValueError:
                self._malformed += 1
                continue
            source.peer = source.peer or address
            releases = source.direction.send(epoch, kind, counter, len(data), now_ns)
            if not releases:
                self._lost += 1
            for release_ns in releases:
                self._hold(release_ns, data, target)

    def _hold(self, release_ns: int, data: bytes, target: _Side) -> None:
        """Keep a datagram until it is due."""
        if len(self._in_flight) >= self._in_flight_max:
            self._overflow += 1
            return
        heapq.heappush(self._in_flight, (release_ns, next(self._numbers), data, target))

    def _release(self) -> None:
        """Send what is due."""
        in_flight = self._in_flight
        while in_flight and in_flight[0][0] <= (now_ns := self._now_ns()):
            due_ns, _, data, target = heapq.heappop(in_flight)
            try:
                if target.peer is None:
                    raise OSError
                target.socket.sendto(data, target.peer)
            except OSError:
                self._unsent += 1
                continue
            self._forwarded += 1
            self._errors_ns.append(now_ns - due_ns)
