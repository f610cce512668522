# SPDX-License-Identifier: Apache-2.0

"""Accept TCP connections, and carry each over the emulated link to a server.

All sockets are non-blocking.
"""

from __future__ import annotations

import select
import selectors
import socket
import time
from collections import deque
from collections.abc import Iterator
from functools import partial

from cloudrc.link.carry.engine import Engine, Packet
from cloudrc.link.carry.tcp.medium import Medium
from cloudrc.link.carry.tcp.stream import LinkStream, run_due

CHUNK = 64 << 10  # most bytes that one call reads [bytes]
BUFFER = 128 << 10  # of the kernel, for each socket and direction [bytes]
TIMES_KEPT = 100_000  # newest request-response times that are kept
_RESET = b"\x01\0\0\0\0\0\0\0"  # struct linger: on, 0 s: close sends RST

Ways = tuple[Medium, Medium]
"""Uplink and downlink."""


class Side:
    """One of the two sockets of a connection, with the stream into it and the stream out of it."""

    source: LinkStream  # gets what this side sends
    origin: LinkStream  # brings what this side gets

    def __init__(self, one: socket.socket, way: Ways, name: str) -> None:
        """Prepare a socket; `way` leads from this side, `name` is that of its direction."""
        self.socket, self.way, self.name = one, way, name
        self.unsent, self.mask = bytearray(), 0
        self.reads = False  # from the opening until the end of what this side sends
        self.ends = self.closed = False  # whether the end has been brought, and handed on
        one.setblocking(False)
        one.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        for option in (socket.SO_RCVBUF, socket.SO_SNDBUF):
            # Larger ones would hide from a sender that the receiver has stopped.
            one.setsockopt(socket.SOL_SOCKET, option, BUFFER)


class RelayedConnection:
    """A client's connection and that to the server, which belong together."""

    def __init__(self, relay: StreamRelay, client: socket.socket, number: int) -> None:
        self.relay, self.number = relay, number
        self.asked_ns, self.dead = 0, False
        up, down = relay.ways
        server = socket.socket(relay.family, socket.SOCK_STREAM)
        self.client = Side(client, (up, down), "uplink")
        self.server = Side(server, (down, up), "downlink")
        self.sides = self.client, self.server
        server.connect_ex(relay.to)
        relay.watch(self, self.server, selectors.EVENT_WRITE)
        now_ns = time.monotonic_ns()
        self.opens_ns = now_ns + up.delay_ns(now_ns) + down.delay_ns(now_ns)

    def handle(self, side: Side, mask: int, now_ns: int) -> None:
        """Handle a socket that can be read or written."""
        if self.dead:
            return
        if not hasattr(side, "source"):
            self._connected(now_ns)
            return
        if mask & selectors.EVENT_WRITE:
            self._flush(side, now_ns)
        if mask & selectors.EVENT_READ:
            self._read(side, now_ns)
        self.update()

    def _connected(self, now_ns: int) -> None:
        """Open the streams, or refuse the client, a round trip after the client has asked."""
        self.relay.watch(self, self.server, 0)
        opens_ns = max(now_ns, self.opens_ns)
        if self.server.socket.getsockopt(socket.SOL_SOCKET, socket.SO_ERROR):
            self.relay.counts["refused"] += 1
            self.relay.engine.queue.put(self.end, (opens_ns,), ())
            return
        self.relay.counts["connections"] += 1
        for side, target in (self.sides, self.sides[::-1]):
            deliver = partial(self._put, target)
            stream = LinkStream(self.relay.engine.queue, side.way, self.number, deliver)
            side.source = target.origin = stream
            side.reads = True
            stream.open(opens_ns)
            opens_ns += side.way[0].delay_ns(opens_ns)  # then the server hears of it
        self.update()

    def update(self) -> None:
        """Watch the sockets for what the streams can take and give."""
        if self.dead:
            return
        for side in self.sides:
            mask = selectors.EVENT_READ if side.reads and side.source.room > 0 else 0
            mask |= selectors.EVENT_WRITE if side.unsent else 0
            self.relay.watch(self, side, mask)
        if self.client.closed and self.server.closed:
            self.end(0, reset=False)

    def _read(self, side: Side, now_ns: int) -> None:
        try:
            data = side.socket.recv(min(CHUNK, side.source.room))
        except BlockingIOError:
            return
        except OSError:
            self._reset(side, now_ns)
            return
        self.relay.counts[f"{side.name}_bytes"] += len(data)
        if side is self.client and data:
            self.asked_ns = now_ns
        side.reads = bool(data)
        side.source.write(data, now_ns)

    def _put(self, side: Side, data: bytes, now_ns: int) -> None:
        """Hand bytes from the link on to a side; b"" is their end."""
        if self.dead:
            return
        if side is self.client and data and self.asked_ns:
            self.relay.response_times.append(now_ns - self.asked_ns)
            self.asked_ns = 0
        side.unsent += data
        side.ends |= not data
        self._flush(side, now_ns)
        self.update()

    def _flush(self, side: Side, now_ns: int) -> None:
        try:
            count = side.socket.send(side.unsent) if side.unsent else 0
            del side.unsent[:count]
            if side.ends and not side.unsent and not side.closed:
                side.closed = True
                side.socket.shutdown(socket.SHUT_WR)
        except BlockingIOError:
            return
        except OSError:
            self._reset(side, now_ns)
            return
        if count:
            side.origin.taken(count, now_ns)

    def _reset(self, side: Side, now_ns: int) -> None:
        """Reset the other side, too, once the news has crossed the link."""
        side.reads = False
        side.unsent.clear()
        self.relay.engine.queue.put(self.end, (now_ns + side.way[0].delay_ns(now_ns),), ())

    def end(self, now_ns: int, *, reset: bool = True) -> None:
        """Close both sockets, by RST with `reset`."""
        if self.dead:
            return
        self.dead = True
        for side in self.sides:
            self.relay.watch(self, side, 0)
            try:
                if reset:
                    side.socket.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, _RESET)
            except OSError:  # it is reset already
                pass
            side.socket.close()
        self.relay.connections.discard(self)


class StreamRelay:
    """Carries all connections to one server over the link.

    Attributes:
        counts: Number of connections, of those that the server refused, and of bytes each way.
        response_times: Times from the last byte of a request to the first byte of its answer [ns].
        engine: Makes the calls of the streams when they are due.
    """

    def __init__(
        self,
        listening: socket.socket,
        to: tuple[str, int],
        family: int,
        ways: Ways,
    ) -> None:
        """Accept connections at the socket `listening`, to a server at the address `to`."""
        self.to, self.family, self.ways = to, family, ways
        self.engine, self.connections = Engine(self, ()), set[RelayedConnection]()
        names = "connections", "refused", "uplink_bytes", "downlink_bytes"
        self.counts = dict.fromkeys(names, 0)
        self.response_times = deque[int](maxlen=TIMES_KEPT)
        self._ready: list[tuple[selectors.SelectorKey, int]] = []
        self._listening, self._selector = listening, selectors.DefaultSelector()
        listening.setblocking(False)
        self._selector.register(listening, selectors.EVENT_READ)
        self._count = 0

    def wait(self, until_ns: int) -> bool:
        """Wait for sockets that can be read or written, or until a time [ns]."""
        wait = max(0.0, (until_ns - time.monotonic_ns()) * 1e-9)
        if wait and hasattr(self._selector, "fileno"):  # its own wait counts milliseconds
            select.select([self._selector.fileno()], (), (), wait)
            wait = 0.0
        self._ready = self._selector.select(wait)
        return bool(self._ready)

    def take(self) -> Iterator[Packet]:
        """Accept and read: the streams put what follows on the engine's queue themselves."""
        for key, mask in self._ready:
            if key.data is None:
                self._accept()
            else:
                connection, side = key.data
                now_ns = time.monotonic_ns()
                run_due(self.engine.queue, now_ns)
                connection.handle(side, mask, now_ns)
        yield from ()

    def watch(self, connection: RelayedConnection, side: Side, mask: int) -> None:
        """Wait for events of a socket; `mask` 0 for none."""
        if mask == side.mask:
            return
        if side.mask:
            self._selector.unregister(side.socket)
        if mask:
            self._selector.register(side.socket, mask, (connection, side))
        side.mask = mask

    def _accept(self) -> None:
        try:
            client, _ = self._listening.accept()
        except (BlockingIOError, ConnectionError):  # the client has gone
            return
        self._count += 1
        self.connections.add(RelayedConnection(self, client, self._count))

    def close(self) -> None:
        """Reset all connections, and accept no more."""
        for connection in list(self.connections):
            connection.end(0)
        self._selector.close()
        self._listening.close()
