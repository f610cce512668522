# SPDX-License-Identifier: Apache-2.0

"""Run one endpoint in real time on a UDP socket and the machine's monotonic clock.

The loop sleeps until the endpoint's next deadline or the next datagram, whichever comes first.
After each sleep (a wake), all new datagrams get the same time of arrival, as endpoints require.
"""

from __future__ import annotations

import gc
import random
import select
import socket
import time
from collections.abc import Callable
from contextlib import ExitStack, suppress
from ipaddress import ip_address
from itertools import islice
from pathlib import Path

from cloudrc.base.errors import MissingPrerequisiteError
from cloudrc.base.files import Watched, read
from cloudrc.link.carry.datagrams import receive_all, send_or_lose
from cloudrc.wire.endpoint import Endpoint
from cloudrc.wire.records import Lateness, Record
from cloudrc.wire.tunnel.codec import DATAGRAM_MAX

Address = tuple[str, int]

DRAIN_MAX = 256
"""Largest number of datagrams per wake, so that a flood does not delay the deadlines."""
RECEIVE_BUFFER = 1 << 22
"""Requested size of the receive buffer [bytes], large enough for a flood and valid datagrams."""
BACKLOG_MAX = 2 * RECEIVE_BUFFER // 512
"""Largest number of datagrams in a wake after a stall: more than fit into the receive buffer. Linux
doubles the requested size, and each datagram takes at least 768 bytes."""
STALL_NS = 50_000_000
"""Lateness above which the loop was stalled [ns]; it then takes all waiting datagrams."""
STALL_AGAIN_NS = 1_000_000_000
"""Replaces `STALL_NS` in the wake after a stall [ns], which is late because the loop has just taken
many datagrams."""
SINK_PERIOD_NS = 20_000_000
"""Longest time between two calls of `sink` while there are records [ns]."""
WAIT_MAX_NS = 100_000_000
"""Longest sleep of the loop [ns]; `stop` is called after every sleep."""
PORTS = range(20_000, 30_000)
"""Ports from which `free_ports` chooses."""
ROUTE_PERIOD_NS = 500_000_000
"""Time between two checks of the route file once the address is known [ns]."""


def split_address(text: str) -> Address:
    """Parse HOST:PORT, with an IPv6 address in brackets; raise a ValueError for other text."""
    host, _, port = text.strip().rpartition(":")
    bare = host.removeprefix("[").removesuffix("]")
    is_port = port.isdecimal() and 0 < int(port) < 65_536
    if not (bare and is_port) or (":" in bare) != host.startswith("["):
        raise ValueError(f"'{text}' is not HOST:PORT, such as world:7400 or [::1]:7400")
    bare.encode("idna")  # raises if a label is too long
    return bare, int(port)


def show_address(where: Address) -> str:
    """Format an address as HOST:PORT, with an IPv6 address in brackets."""
    host, port = where
    return f"[{host}]:{port}" if ":" in host else f"{host}:{port}"


class Peer:
    """A UDP socket and the address to which it sends.

    Attributes:
        socket: The socket, bound and not blocking.
        address: Address of the peer: world, cloud or the relay; None while it is unknown.
    """

    def __init__(self, socket: socket.socket, route: Path) -> None:
        """Use a bound socket; the link process writes HOST:PORT to the file `route`."""
        self.socket, self._route = socket, Watched(route, ROUTE_PERIOD_NS)
        self.address: Address | None = None

    def follow(self, now_ns: int) -> None:
        """Update the address from the route file, if a check is due at `now_ns` [ns].

        While the address is unknown, each call checks the file. If the file is missing or
        incomplete, or contains a host name, keep the last address: a query to a name server would
        block the loop.
        """
        if self._route.is_new(now_ns, at_once=self.address is None):
            with suppress(OSError, ValueError):
                address = split_address(read(self._route.path).decode("ascii"))
                ip_address(address[0])
                self.address = _reachable(self.socket, address)

    def receive(self, most: int = DRAIN_MAX) -> list[bytes]:
        """Return at most `most` of the datagrams that have arrived.

        A datagram longer than DATAGRAM_MAX is cut to DATAGRAM_MAX + 1 bytes; decoding rejects it.
        """
        return list(islice(receive_all(self.socket, DATAGRAM_MAX + 1), most))

    def send(self, datagrams: list[bytes]) -> None:
        """Send datagrams; drop them if the address is unknown or the socket rejects them."""
        if self.address is not None:
            for data in datagrams:
                send_or_lose(self.socket, data, self.address)


def _reachable(bound: socket.socket, address: Address) -> Address:
    """Convert an IPv4 address to an IPv6 address if the socket `bound` uses IPv6."""
    if bound.family != socket.AF_INET6 or ":" in address[0]:
        return address
    return f"::ffff:{address[0]}", address[1]


def bind(listen: Address) -> socket.socket:
    """Open a non-blocking UDP socket; the host `::` receives IPv6 and IPv4."""
    family = socket.AF_INET6 if ":" in listen[0] else socket.AF_INET
    udp = socket.socket(family, socket.SOCK_DGRAM)
    if listen[0] == "::":
        udp.setsockopt(socket.IPPROTO_IPV6, socket.IPV6_V6ONLY, 0)
    udp.setblocking(False)
    udp.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, RECEIVE_BUFFER)
    try:
        udp.bind(listen)
    except OSError:
        udp.close()
        raise
    return udp


def free_ports(count: int, width: int = 1) -> list[int]:
    """Choose random ports on 127.0.0.1 that are unused for both UDP and TCP.

    The kernel uses another range for outgoing connections, so the ports stay free. Each is the
    first of `width` unused ports.
    """
    found: list[int] = []
    starts = PORTS[::width]
    for port in random.SystemRandom().sample(starts, len(starts)):
        with suppress(OSError), ExitStack() as opened:
            for one in range(port, port + width):
                for kind in (socket.SOCK_DGRAM, socket.SOCK_STREAM):
                    tried = opened.enter_context(socket.socket(type=kind))
                    tried.bind(("127.0.0.1", one))
            found.append(port)
        if len(found) == count:
            return found
    raise MissingPrerequisiteError(
        f"127.0.0.1 has fewer than {count} free ports from {PORTS[0]} to {PORTS[-1]}; "
        "end a program that uses them"
    )


def serve(
    endpoint: Endpoint,
    peer: Peer,
    *,
    end: str,
    sink: Callable[[list[Record]], None],
    stop: Callable[[], bool],
    slip_ns: Callable[[], int] = lambda: 0,
) -> None:
    """Run world or cloud in real time until `stop()` is true.

    Args:
        endpoint: World or cloud.
        peer: Socket of the endpoint, and address of the other endpoint.
        end: "world" or "cloud", for the records.
        sink: Called with new records, at least every 20 ms if there are any. It must not block.
        stop: Called at every wake, at least every 100 ms.
        slip_ns: Returns the lag of the endpoint's clock behind the machine's monotonic clock [ns].
    """
    gc.collect()
    gc.freeze()  # the garbage collector then skips all objects loaded so far
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
