"""Real time: one endpoint, one UDP socket, the machine's monotonic clock.

The loop sleeps until the endpoint's next deadline or the next datagram, whichever comes first.
All datagrams that are drained in one wake carry the same instant, as the endpoint's contract asks.

The route file: one line HOST:PORT that says where this pod's end of the tunnel has to send.

The link's process writes it once the way is open, and again when the peer moves; the loop looks at
it twice a second. A look costs a system call, so the host is a number: a name would have to be
asked for, and the loop would wait for the answer.
"""

from __future__ import annotations

import gc
import select
import socket
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from ipaddress import AddressValueError, IPv4Address
from pathlib import Path

from cloudrc.endpoint import Endpoint
from cloudrc.files import read, version
from cloudrc.records import Lateness, Record
from cloudrc.tunnel.codec import DATAGRAM_MAX

Address = tuple[str, int]


class Route:
    """Follows the file; what cannot be read changes nothing."""

    def __init__(self, path: Path) -> None:
        """Follow the file at `path`, which need not be there yet."""
        self._path = path
        self._seen: tuple[int, int, int] | None = None
        self._address: Address | None = None

    def look(self) -> Address | None:
        """Where to send; None before the file has been there.

        A file that is gone, or half written, leaves the last address in place.
        """
        try:
            seen = version(self._path)
            if seen != self._seen:
                self._address = parse(read(self._path).decode("ascii"))
                self._seen = seen
        except (OSError, ValueError):
            self._seen = None
        return self._address


def parse(text: str) -> Address:
    """Read HOST:PORT.

    Raises:
        ValueError: If it is not an IPv4 address in numbers and a port.
    """
    host, _, port = text.strip().rpartition(":")
    try:
        numeric = str(IPv4Address(host))
    except AddressValueError as error:
        raise ValueError(f"'{host}' is not an address in numbers") from error
    if not port.isdecimal() or not 0 < int(port) < 65_536:
        raise ValueError(f"'{port}' is not a port")
    return numeric, int(port)


DRAIN_MAX = 256
"""Datagrams taken per wake, so that a flood cannot keep the loop from its deadlines."""
RECEIVE_BUFFER = 1 << 22
"""Asked of the kernel, which may give less: room for honest datagrams behind a flood [bytes]."""
BACKLOG_MAX = 2 * RECEIVE_BUFFER // 512
"""More than can wait in the socket: Linux doubles the room, a datagram takes 768 bytes at least."""
STALL_NS = 50_000_000
"""After a wake this late all that waits is taken at once: it came before that wake [ns]."""
STALL_AGAIN_NS = 1_000_000_000
"""After a wake that was itself late only one this late [ns]: a flood that takes that long to take
in would keep the loop in it. What honest peers send in less fits into `DRAIN_MAX`."""
SINK_PERIOD_NS = 20_000_000
WAIT_MAX_NS = 100_000_000
ROUTE_PERIOD_NS = 500_000_000
"""How often it is asked whether the route has changed [ns]."""


@dataclass
class Peer:
    """A UDP socket and whom it talks to.

    Attributes:
        socket: Bound, not blocking.
        address: Of the other end of the tunnel, or of the relay before it; None while the route
            to it is unknown.
        route: Says where the other end is, and may change its mind; None if it never moves.
        unsent: How many datagrams could not be sent.
    """

    socket: socket.socket
    address: tuple[str, int] | None
    route: Route | None = None
    unsent: int = field(default=0)
    _followed_ns: int = field(default=0, init=False)

    @classmethod
    def bind(cls, listen: tuple[str, int], where: tuple[str, int] | Route) -> Peer:
        """Bind a socket at `listen`; send to an address, or to where a route leads."""
        if isinstance(where, Route):
            return cls(bind(listen), None, where)
        return cls(bind(listen), where)

    def follow(self, now_ns: int) -> None:
        """Look where the route leads, if that is due at `now_ns` [ns]."""
        if self.route is not None and now_ns >= self._followed_ns:
            self._followed_ns = now_ns + ROUTE_PERIOD_NS
            self.address = self.route.look()

    def receive(self, most: int = DRAIN_MAX) -> list[bytes]:
        """What waits in the socket; one byte too many marks an oversized datagram."""
        datagrams: list[bytes] = []
        while len(datagrams) < most:
            try:
                datagrams.append(self.socket.recv(DATAGRAM_MAX + 1))
            except BlockingIOError:
                break
            except ConnectionRefusedError:  # an earlier datagram of ours found nobody listening
                continue
        return datagrams

    def send(self, datagrams: list[bytes]) -> None:
        """Send; what the network refuses counts as lost, as UDP has it."""
        if self.address is None:
            self.unsent += len(datagrams)
            return
        for data in datagrams:
            try:
                self.socket.sendto(data, self.address)
            except OSError:
                self.unsent += 1


def bind(listen: tuple[str, int]) -> socket.socket:
    """Open a UDP socket that does not block."""
    udp = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    udp.setblocking(False)
    udp.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, RECEIVE_BUFFER)
    try:
        udp.bind(listen)
    except OSError:
        udp.close()
        raise
    return udp


def free_ports(count: int, kind: socket.SocketKind = socket.SOCK_DGRAM) -> list[int]:
    """Find ports on 127.0.0.1 that nobody uses now."""
    sockets = [socket.socket(socket.AF_INET, kind) for _ in range(count)]
    try:
        for one in sockets:
            one.bind(("127.0.0.1", 0))
        return [int(one.getsockname()[1]) for one in sockets]
    finally:
        for one in sockets:
            one.close()


def serve(
    endpoint: Endpoint,
    peer: Peer,
    *,
    end: str,
    sink: Callable[[list[Record]], None],
    stop: Callable[[], bool],
    slip_ns: Callable[[], int] = lambda: 0,
) -> None:
    """Run an endpoint in real time until `stop()` is true.

    Args:
        endpoint: World or cloud.
        peer: Its socket.
        end: "world" or "cloud", for the records.
        sink: Gets the records, at least every 20 ms; must not block.
        stop: Asked at every wake, at most 100 ms apart.
        slip_ns: By how much world's clock lags [ns].

    Raises:
        ValueError: If its datagrams are not sealed.
    """
    if not endpoint.sealed:
        raise ValueError(f"{end} has no key, and nothing leaves a process unsealed")
    gc.collect()
    gc.freeze()  # what is loaded now stays: the collector need not look at it in flight
    stalled, sink_ns = False, time.monotonic_ns()
    while not stop():
        deadline_ns = endpoint.next_deadline_ns()
        wait_ns = min(deadline_ns - time.monotonic_ns(), WAIT_MAX_NS)
        readable, _, _ = select.select([peer.socket], [], [], max(wait_ns, 0) * 1e-9)
        now_ns = time.monotonic_ns()
        stalled = now_ns - deadline_ns > (STALL_AGAIN_NS if stalled else STALL_NS)
        if readable:
            for data in peer.receive(BACKLOG_MAX if stalled else DRAIN_MAX):
                endpoint.receive_datagram(data, now_ns)
        if now_ns >= deadline_ns:
            endpoint.handle_deadline(now_ns)
        peer.follow(now_ns)
        peer.send(endpoint.take_datagrams())
        done_ns = time.monotonic_ns()
        records = endpoint.take_records() if now_ns >= deadline_ns or now_ns >= sink_ns else []
        if now_ns >= deadline_ns:
            late, busy, slip = now_ns - deadline_ns, done_ns - now_ns, slip_ns()
            records.append(Lateness(now_ns - slip, end, late * 1e-9, busy * 1e-9, slip))
        if records:
            sink(records)
            sink_ns = now_ns + SINK_PERIOD_NS
    sink(endpoint.take_records())
