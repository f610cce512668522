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
from contextlib import suppress
from functools import partial

from cloudrc.link.carry.engine import Engine, Packet
from cloudrc.link.carry.tcp.medium import Medium
from cloudrc.link.carry.tcp.stream import LinkStream, run_due

CHUNK = 64 << 10  # most bytes that one call reads [bytes]
BUFFER = 128 << 10  # of the kernel, for each socket and direction [bytes]
ACCEPTED_MAX = 64  # connections that one turn of the loop accepts
TURNS_KEPT = 100_000  # newest turns of which the times are kept
_RESET = b"\x01\0\0\0\0\0\0\0"  # struct linger: on, 0 s: close sends RST

Ways = tuple[Medium, Medium]
"""Uplink and downlink."""


class Side:
    """One of the two sockets of a connection, with the stream into it and the stream out of it."""

    def __init__(self, one: socket.socket) -> None:
        self.socket, self.unsent = one, bytearray()
        self.source: LinkStream | None = None  # gets what this side sends
        self.origin: LinkStream | None = None  # brings what this side gets
        self.reads = True  # until the end of what this side sends
        self.ends = self.closed = False  # whether the end has been brought, and handed on
        self.mask = 0


class RelayedConnection:
    """A client's connection and that to the server, which belong together."""

    def __init__(self, relay: StreamRelay, client: socket.socket, number: int) -> None:
        self.relay, self.number = relay, number
        self.client = Side(client)
        self.server = Side(socket.socket(relay.family, socket.SOCK_STREAM))
        self.connecting, self.asked_ns, self.dead = True, 0, False
        for side in (self.client, self.server):
            side.socket.setblocking(False)
            side.socket.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
            for option in (socket.SO_RCVBUF, socket.SO_SNDBUF):
                # Larger ones would hide from a sender that the receiver has stopped.
                side.socket.setsockopt(socket.SOL_SOCKET, option, BUFFER)
        self.server.socket.connect_ex(relay.to)
        relay.watch(self, self.server, selectors.EVENT_WRITE)
        up, down = relay.ways
        now_ns = time.monotonic_ns()
        self.opens_ns = now_ns + up.delay_ns(now_ns) + down.delay_ns(now_ns)

    def handle(self, side: Side, mask: int, now_ns: int) -> None:
        """Handle a socket that can be read or written."""
        if self.dead:
            return
        if side is self.server and self.connecting:
            self._connected(now_ns)
            return
        if mask & selectors.EVENT_WRITE:
            self._flush(side, now_ns)
        if mask & selectors.EVENT_READ and not self.dead:
            self._read(side, now_ns)
        self.update()

    def _connected(self, now_ns: int) -> None:
        """Open the streams, or refuse the client, a round trip after the client has asked."""
        self.connecting = False
        self.relay.watch(self, self.server, 0)
        opens_ns = max(now_ns, self.opens_ns)
        if self.server.socket.getsockopt(socket.SOL_SOCKET, socket.SO_ERROR):
            self.relay.refused += 1
            self.relay.engine.queue.put(self.end, (opens_ns,), ())
            return
        self.relay.connected += 1
        up, down = self.relay.ways
        self._join(self.client, self.server, (up, down), opens_ns)
        self._join(self.server, self.client, (down, up), opens_ns + up.delay_ns(opens_ns))
        self.update()

    def _join(self, source: Side, target: Side, way: Ways, opens_ns: int) -> None:
        """Make the stream from one side to the other."""
        deliver = partial(self._put, target)
        stream = LinkStream(self.relay.engine.queue, way, self.number, deliver)
        source.source = target.origin = stream
        stream.open(opens_ns)

    def update(self) -> None:
        """Watch the sockets for what the streams can take and give."""
        if self.dead:
            return
        for side in (self.client, self.server):
            reads = side.reads and side.source is not None and side.source.room > 0
            mask = selectors.EVENT_READ if reads else 0
            mask |= selectors.EVENT_WRITE if side.unsent else 0
            self.relay.watch(self, side, mask)
        if self.client.closed and self.server.closed:
            self.end(0, reset=False)

    def _read(self, side: Side, now_ns: int) -> None:
        assert side.source is not None
        try:
            data = side.socket.recv(min(CHUNK, side.source.room))
        except BlockingIOError:
            return
        except OSError:
            self._reset(side, now_ns)
            return
        if side is self.client:
            self.relay.up_bytes += len(data)
            self.asked_ns = now_ns if data else self.asked_ns
        else:
            self.relay.down_bytes += len(data)
        side.reads = bool(data)
        side.source.write(data, now_ns)

    def _put(self, side: Side, data: bytes, now_ns: int) -> None:
        """Hand bytes from the link on to a side; b"" is their end."""
        if self.dead:
            return
        if side is self.client and data and self.asked_ns:
            self.relay.turns.append(now_ns - self.asked_ns)
            self.asked_ns = 0
        side.unsent += data
        side.ends |= not data
        self._flush(side, now_ns)
        self.update()

    def _flush(self, side: Side, now_ns: int) -> None:
        assert side.origin is not None
        count = 0
        try:
            if side.unsent:
                count = side.socket.send(side.unsent)
            del side.unsent[:count]
            if side.ends and not side.unsent and not side.closed:
                side.closed = True
                side.socket.shutdown(socket.SHUT_WR)
        except BlockingIOError:
            pass
        except OSError:
            self._reset(side, now_ns)
            return
        if count:
            side.origin.taken(count, now_ns)

    def _reset(self, side: Side, now_ns: int) -> None:
        """Reset the other side, too, once the news has crossed the link."""
        self.relay.watch(self, side, 0)
        side.reads = False
        up, down = self.relay.ways
        way = up if side is self.client else down
        self.relay.engine.queue.put(self.end, (now_ns + way.delay_ns(now_ns),), ())

    def end(self, now_ns: int, *, reset: bool = True) -> None:
        """Close both sockets, by RST with `reset`."""
        if self.dead:
            return
        self.dead = True
        for side in (self.client, self.server):
            self.relay.watch(self, side, 0)
            if reset:
                with suppress(OSError):
                    side.socket.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, _RESET)
            side.socket.close()
        self.relay.connections.discard(self)


class StreamRelay:
    """Carries all connections to one server over the link.

    Attributes:
        turns: Times from the last byte of a request to the first byte of its answer [ns].
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
        self.connected = self.refused = self.up_bytes = self.down_bytes = 0
        self.turns = deque[int](maxlen=TURNS_KEPT)
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
        if not mask:
            self._selector.unregister(side.socket)
        elif not side.mask:
            self._selector.register(side.socket, mask, (connection, side))
        else:
            self._selector.modify(side.socket, mask, (connection, side))
        side.mask = mask

    def _accept(self) -> None:
        with suppress(BlockingIOError):
            for _ in range(ACCEPTED_MAX):
                client, _ = self._listening.accept()
                self._count += 1
                self.connections.add(RelayedConnection(self, client, self._count))

    def close(self) -> None:
        """Reset all connections, and accept no more."""
        for connection in list(self.connections):
            connection.end(0)
        self._selector.close()
        self._listening.close()
