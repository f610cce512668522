"""Let viser serve connections that another thread has accepted and checked.

viser 1.1.1 opens a port itself, answers every request there, and accepts messages of 50 MB. It has
no setting for this. `viser_behind` therefore replaces the function with which viser opens its port.
"""

from __future__ import annotations

import asyncio
import socket
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import partial
from queue import SimpleQueue
from typing import Any

import websockets.asyncio.server
from websockets.frames import DATA_OPCODES, Frame

MESSAGE_MAX = 1 << 20
"""Size limit of a message from a browser [bytes]."""
MESSAGE_TIME = 10.0
"""Time limit for a browser to send a message completely [s]."""
_serve = websockets.asyncio.server.serve


class HandedSockets(socket.socket):
    """A listening socket whose connections come from `hand` instead of from the network."""

    def __init__(self, address: tuple[str, int]) -> None:
        """Make it; `address` is the address at which the other thread listens."""
        read, self._wake = socket.socketpair()
        super().__init__(fileno=read.detach())
        self._address, self._queue = address, SimpleQueue[socket.socket]()

    def hand(self, connection: socket.socket) -> None:
        """Serve an accepted connection; call it from any thread."""
        self._queue.put(connection)
        self._wake.send(b"1")

    def accept(self) -> tuple[socket.socket, Any]:
        """Return the next connection; raise a BlockingIOError if there is none."""
        self.recv(1)
        return self._queue.get_nowait(), None

    def listen(self, backlog: int = 0, /) -> None:
        """Do nothing: the other thread listens."""

    def getsockname(self) -> tuple[str, int]:
        """Return the address of the other thread's socket."""
        return self._address

    def close(self) -> None:
        """Close it, and the connections that nobody has accepted."""
        super().close()
        self._wake.close()
        while not self._queue.empty():
            self._queue.get_nowait().close()


class Connection(websockets.asyncio.server.ServerConnection):
    """A browser's WebSocket, with a time limit for a message."""

    def __init__(self, ended: Callable[[], None], *arguments: Any, **settings: Any) -> None:
        """Make it; `ended` is called after its end."""
        super().__init__(*arguments, **settings)
        self._ended = ended
        self._is_fragment = self._has_finished = False
        self._limit: asyncio.TimerHandle | None = None

    def process_event(self, event: Any) -> None:
        """Process a frame or the handshake."""
        if isinstance(event, Frame) and event.opcode in DATA_OPCODES:
            self._is_fragment = not event.fin
            self._has_finished |= event.fin
        super().process_event(event)

    def data_received(self, data: bytes) -> None:
        """Process bytes from the network; start, keep or end the time limit of a message."""
        self._has_finished = False
        super().data_received(data)
        is_unfinished = self._is_fragment or bool(self.protocol.reader.buffer)
        if self._limit and (self._has_finished or not is_unfinished):
            self._limit.cancel()
            self._limit = None
        if is_unfinished and self._limit is None:
            self._limit = self.loop.call_later(MESSAGE_TIME, self.transport.abort)

    def connection_lost(self, exc: Exception | None) -> None:
        """Count the connection as ended."""
        if self._limit:
            self._limit.cancel()
        super().connection_lost(exc)
        self._ended()


@contextmanager
def viser_behind(listener: HandedSockets, ended: Callable[[], None]) -> Iterator[None]:
    """Let a viser server that starts in the `with` block serve the connections of `listener`.

    `ended` is called after the end of each connection.

    Raises:
        RuntimeError: If viser has not used the replaced function.
    """
    used = False

    def serve(handler: Any, _host: str, _port: int, **settings: Any) -> Any:
        nonlocal used
        used = True
        ours = {"max_size": MESSAGE_MAX, "process_request": None, "sock": listener}
        connection: Any = partial(Connection, ended)
        return _serve(handler, create_connection=connection, **{**settings, **ours})

    websockets.asyncio.server.serve = serve  # type: ignore[assignment, misc]
    try:
        yield
    finally:
        websockets.asyncio.server.serve = _serve  # type: ignore[misc]
    if not used:
        raise RuntimeError("viser opens its port in another way: see cloudrc/console/handed.py")
