"""Connections of the API: clients that dawdle are cut off, and too many make the slowest leave.

A request's head has 5 s from the connection, or from the answer before it; an answer has 10 s to be
taken once its buffer is full. When there are too many connections the one that has waited longest
without a request goes, so that whoever asks at once is always served.
"""

from __future__ import annotations

import asyncio
from collections import Counter
from typing import Any

from uvicorn.protocols.http.h11_impl import H11Protocol

HEAD_LIMIT = 5.0
"""For the head of a request to arrive [s]."""
SEND_LIMIT = 10.0
"""For a client to take what it is sent [s]."""
CONNECTIONS_MAX = 256
READ_MAX = 1_024
"""Taken from a connection before it is another's turn [bytes]: in chunks of one byte each that is
some 1 ms of work; asyncio's own 256 KiB would be a quarter of a second."""


class Crowd:
    """All connections of a server.

    Attributes:
        idle: Those that are not being answered, the longest idle first.
        counts: How many were cut off, by reason.
    """

    def __init__(self) -> None:
        self.idle: dict[PatientProtocol, None] = {}
        self.counts: Counter[str] = Counter()

    def protocol(self) -> type[PatientProtocol]:
        """Give the class of this server's connections, as uvicorn wants it."""
        return type("CrowdProtocol", (PatientProtocol,), {"crowd": self})


class PatientProtocol(H11Protocol):
    """One connection, whose patience ends."""

    crowd: Crowd
    _head_timer: asyncio.TimerHandle | None = None
    _send_timer: asyncio.TimerHandle | None = None

    def connection_made(self, transport: Any) -> None:
        """Somebody has come."""
        super().connection_made(transport)
        transport.max_size = READ_MAX
        self._watch()
        if len(self.connections) > CONNECTIONS_MAX:
            next(iter(self.crowd.idle))._cut_off("busy")

    def connection_lost(self, exc: Exception | None) -> None:
        """Somebody has left."""
        super().connection_lost(exc)
        self._forget()
        self.resume_writing()

    def data_received(self, data: bytes) -> None:
        """Something has arrived: perhaps the end of a request's head."""
        super().data_received(data)
        self._watch()

    def on_response_complete(self) -> None:
        """An answer is given: the next request may come."""
        if self._has_chunks_left():  # nobody wants them, and to take them apart is work
            self.transport.close()
        super().on_response_complete()
        self._watch()

    def pause_writing(self) -> None:
        """The client does not take what it is sent as fast as it is sent."""
        super().pause_writing()
        if self._send_timer is None:
            self._send_timer = self.loop.call_later(SEND_LIMIT, self._cut_off, "slow")

    def resume_writing(self) -> None:
        """The client goes on taking it."""
        super().resume_writing()
        if self._send_timer is not None:
            self._send_timer.cancel()
            self._send_timer = None

    def _has_chunks_left(self) -> bool:
        chunked = any(name == b"transfer-encoding" for name, _ in self.headers)
        return chunked and self.cycle.more_body

    def _watch(self) -> None:
        """While no request is being answered, time runs."""
        answering = self.cycle is not None and not self.cycle.response_complete
        if answering or self.transport.is_closing():
            self._forget()
        elif self._head_timer is None:
            self._head_timer = self.loop.call_later(HEAD_LIMIT, self._cut_off, "slow")
            self.crowd.idle[self] = None

    def _forget(self) -> None:
        self.crowd.idle.pop(self, None)
        if self._head_timer is not None:
            self._head_timer.cancel()
            self._head_timer = None

    def _cut_off(self, reason: str) -> None:
        self.crowd.counts[reason] += 1
        self.transport.abort()
        self._forget()
