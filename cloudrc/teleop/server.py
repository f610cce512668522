"""The API's server: an ASGI application on a thread of its own, beside teleop's loop.

The gate before the API: every request comes in; those of known callers, and few enough, go on.

Denied by default: whatever the path, without a valid token it is 401, and with a reader's token
everything but looking is 403. A flood of either is answered with 429 and reaches nothing. Behind
the gate are the routes. An operator's emergency stop has a lane of its own: it alone, by path and
method, is never counted against anybody's room.

Connections of the API: clients that dawdle are cut off, and too many make the slowest leave.

A request's head has 5 s from the connection, or from the answer before it; an answer has 10 s to be
taken once its buffer is full. When there are too many connections the one that has waited longest
without a request goes, so that whoever asks at once is always served.
"""

from __future__ import annotations

import asyncio
import json
import os
import socket
import threading
import time
from collections import Counter
from collections.abc import Awaitable, Callable, MutableMapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeAlias

import uvicorn
from uvicorn.protocols.http.h11_impl import H11Protocol

from cloudrc.errors import BadInputError
from cloudrc.teleop.auth import LOCAL, OPERATOR, Audit, Caller, RevokedError, Tokens
from cloudrc.teleop.bridge import LANE, Bridge

Scope: TypeAlias = MutableMapping[str, Any]
Receive: TypeAlias = Callable[[], Awaitable[MutableMapping[str, Any]]]
Send: TypeAlias = Callable[[MutableMapping[str, Any]], Awaitable[None]]
App: TypeAlias = Callable[[Scope, Receive, Send], Awaitable[None]]

ESTOP = "/v1/estop"
EVENTS = "/v1/events"
LOOKING = ("GET", "HEAD")
ORDERS = ("/v1/missions", "/v1/goto")
"""Where missions are ordered, and points to fly to."""
REFUSED = {409: "order_conflict", 413: "order_invalid", 422: "order_invalid"}
"""What the application refuses of them, by status."""
REFUSALS_NOTED = (1 / 60, 20)
"""How many of a reader's refused commands are written down each: in a second, and at once. Even at
their longest it takes them days to fill the audit log's two files."""
ANSWER_MAX = 4_096
"""How much of a streamed answer is kept for the audit log [bytes]."""


@dataclass(frozen=True, slots=True)
class Limits:
    """How much is let through.

    Attributes:
        rate_hz: Requests of each role, and of all strangers together [1/s].
        burst: That may come at once.
        in_flight: Requests of each role that are worked on at once.
        streams: Of events, of each role, at once.
    """

    rate_hz: float = 100.0
    burst: int = 200
    in_flight: int = 64
    streams: int = 16


class Bucket:
    """Lets through so many in a second, and so many at once."""

    def __init__(self, rate_hz: float, burst: int) -> None:
        self._rate, self._burst = rate_hz, float(burst)
        self._left, self._filled = float(burst), time.monotonic()

    def take(self) -> bool:
        """Whether there is room for one more."""
        now = time.monotonic()
        self._left = min(self._burst, self._left + (now - self._filled) * self._rate)
        self._filled = now
        if self._left < 1.0:
            return False
        self._left -= 1.0
        return True


class Gate:
    """An ASGI application before another one.

    Attributes:
        counts: What was done with requests, by reason; "served" for those let through.
        open: Whether everybody is let through: before a socket that its owner alone can open.
    """

    def __init__(
        self,
        app: App,
        tokens: Tokens | None,
        audit: Audit | None = None,
        limits: Limits | None = None,
        complain: Callable[[str], None] = lambda text: None,
    ) -> None:
        """Stand before an application.

        Args:
            app: Behind the gate.
            tokens: Who is known; None if everybody who can connect is the robot's owner.
            audit: Gets what was commanded.
            limits: How much is let through.
            complain: Gets a line about what should not have happened.
        """
        limits, self._complain = limits or Limits(), complain
        self._app, self._tokens, self._audit, self._limits = app, tokens, audit, limits
        self._buckets = {
            role: Bucket(limits.rate_hz, limits.burst) for role in ("operator", "reader", None)
        }
        self._noted = Bucket(*REFUSALS_NOTED)
        self._in_flight: Counter[tuple[str, str]] = Counter()  # by role and kind
        self.counts: Counter[str] = Counter()
        self.open = tokens is None

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Serve one request."""
        caller = self._caller(scope)
        refusal = self._refusal(caller, scope)
        answer = Answer(send)
        if refusal is not None:
            reason, status, detail = refusal
            self._count(reason)
            await answer.refuse(status, detail)
        else:
            assert caller is not None, "strangers are refused"
            await self._serve(caller, scope, receive, answer)
        if caller is not None and scope["method"] not in LOOKING and answer.status != 429:
            self._note(caller, scope, answer)

    def _caller(self, scope: Scope) -> Caller | None:
        if self._tokens is None:
            return LOCAL
        found = [value for name, value in scope["headers"] if name == b"authorization"]
        return self._tokens.caller(found[0] if len(found) == 1 else None)

    def _refusal(self, caller: Caller | None, scope: Scope) -> tuple[str, int, str] | None:
        """Why a request is not served, if it is not: reason, status, detail."""
        busy = ("busy", 429, "too many requests; try again in a second")
        if caller is None:
            if not self._buckets[None].take():
                return busy
            return "token", 401, "a valid token is needed: Authorization: Bearer TOKEN"
        if _stops(caller, scope):
            return None
        # What is refused takes room, too: to say no, and to write it down, is work.
        kind = _kind(caller, scope)
        room = self._limits.streams if kind[1] == "stream" else self._limits.in_flight
        if self._in_flight[kind] >= room or not self._buckets[caller.role].take():
            return busy
        if scope["method"] not in LOOKING and caller.role != OPERATOR:
            return "role", 403, "this token may look, not command: an operator's is needed"
        return None

    async def _serve(
        self, caller: Caller, scope: Scope, receive: Receive, answer: Answer
    ) -> None:  # fmt: skip
        kind = _kind(caller, scope)
        self._in_flight[kind] += 1
        LANE.set(caller.role)
        send: Send = answer.send
        if kind[1] == "stream":
            send = self._while_known(caller, scope, answer)
        else:
            receive = self._from_known(caller, scope, receive)
        try:
            await self._app(scope, receive, send)
            self._count("served")
            if scope["path"] in ORDERS and answer.status in REFUSED:
                self._count(REFUSED[answer.status])
        except Exception as error:  # a client must not be able to fill a log with tracebacks
            if not self._count("failed"):
                self._complain(f"the API failed at {scope['path']}: {error!r}")
            if not answer.status:
                await answer.refuse(500, "the API failed; see teleop's log")
        finally:
            self._in_flight[kind] -= 1

    def _while_known(self, caller: Caller, scope: Scope, answer: Answer) -> Send:
        """Pass a stream on until its token is taken away: then it is at its end."""
        ended = False

        async def send(message: MutableMapping[str, Any]) -> None:
            nonlocal ended
            if ended:  # the application has yet to hear of it
                return
            if message["type"] == "http.response.body" and self._caller(scope) != caller:
                ended, message = True, {"type": "http.response.body", "body": b""}
            await answer.send(message)

        return send

    def _from_known(self, caller: Caller, scope: Scope, receive: Receive) -> Receive:
        """Take a body in until its token is taken away: what a slow one asks for is not done."""

        async def read() -> MutableMapping[str, Any]:
            message = await receive()
            if message["type"] == "http.request" and self._caller(scope) != caller:
                raise RevokedError
            return message

        return read

    def _count(self, outcome: str) -> int:
        """Count one; say how many there were before."""
        self.counts[outcome] += 1
        return self.counts[outcome] - 1

    def _note(self, caller: Caller, scope: Scope, answer: Answer) -> None:
        if self._audit is None:
            return
        if answer.status == 403 and not self._noted.take():
            self._audit.leave_out()
            return
        client = scope.get("client")
        said = answer.said()
        self._audit.note(
            role=caller.role,
            token=caller.name,
            client=f"{client[0]}:{client[1]}" if client else "local",
            action=f"{scope['method']} {scope['path']}"[:200],
            mission=said.get("id"),
            status=answer.status,
            outcome=said.get("detail") or said.get("state") or "",
        )


def _stops(caller: Caller, scope: Scope) -> bool:
    """Whether this is an operator's emergency stop; to look at its path is a request like any."""
    stop = scope["method"] == "POST" and scope["path"] == ESTOP
    return stop and caller.role == OPERATOR


def _kind(caller: Caller, scope: Scope) -> tuple[str, str]:
    """Whose room a request takes, and which: that of stops is not counted."""
    if _stops(caller, scope):
        return caller.role, "stop"
    return caller.role, "stream" if scope["path"] == EVENTS else "request"


class Answer:
    """What goes back to a client.

    Attributes:
        status: Of HTTP; 0 until it has begun.
    """

    def __init__(self, send: Send) -> None:
        self._send, self._body = send, b""
        self.status = 0

    async def send(self, message: MutableMapping[str, Any]) -> None:
        """Pass a message on."""
        if message["type"] == "http.response.start":
            self.status = message["status"]
        elif len(self._body) < ANSWER_MAX:
            self._body += message.get("body", b"")
        await self._send(message)

    async def refuse(self, status: int, detail: str) -> None:
        """Say no."""
        body = json.dumps({"detail": detail}).encode()
        headers = [(b"content-type", b"application/json"), (b"content-length", b"%d" % len(body))]
        if status == 401:
            headers.append((b"www-authenticate", b"Bearer"))
        if status == 429:
            headers.append((b"retry-after", b"1"))
        await self.send({"type": "http.response.start", "status": status, "headers": headers})
        await self.send({"type": "http.response.body", "body": body})

    def said(self) -> dict[str, Any]:
        """The answer, as far as it is short JSON."""
        try:
            found = json.loads(self._body)
        except ValueError:
            return {}
        return found if isinstance(found, dict) else {}


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


Address: TypeAlias = tuple[str, int] | Path
"""Host and port, or the path of a Unix socket."""
STOP_LIMIT = 1.0
"""For requests to end once the server shall stop [s]."""
BACKLOG = 1_024
"""Connections that the kernel keeps until they are taken."""
ACCEPT_MAX = 16
"""Connections taken before those that are there are read: of more, the emergency stop's could be
the longest without a request, and be cut off, though it is there."""
HEAD_MAX = 4_096
"""Length of a request's head [bytes]; one of shortest lines is 4 ms of work."""


class ApiServer:
    """Serves from `start` to `stop`.

    Attributes:
        url: Where; "unix:PATH" for a Unix socket.
    """

    def __init__(self, gate: Gate, bridge: Bridge, address: Address) -> None:
        """Bind; port 0 lets the kernel choose.

        Args:
            gate: Before the application.
            bridge: To teleop's loop.
            address: A Unix socket's file is for its owner alone.

        Raises:
            BadInputError: If the address cannot be had, or anybody there could command.
        """
        if gate.open and not isinstance(address, Path):
            raise BadInputError(
                "--api HOST:PORT needs --tokens DIR, with a file 'operator' in it; "
                "without tokens only a socket file is served: --api unix:PATH"
            )
        self._crowd, self._gate, self._bridge = Crowd(), gate, bridge
        self._socket, self.url = _bound(address)
        self._server = _Server(
            uvicorn.Config(
                gate,
                loop="asyncio",
                http=self._crowd.protocol(),
                ws="none",
                lifespan="off",
                log_level="critical",  # a flood is refused without a line for each
                access_log=False,
                server_header=False,
                proxy_headers=False,  # the audit log names whoever connects, not whom they name
                backlog=ACCEPT_MAX,
                h11_max_incomplete_event_size=HEAD_MAX,
                timeout_keep_alive=round(HEAD_LIMIT),
                timeout_graceful_shutdown=1,
            )
        )
        # A daemon, so that a client that hangs cannot keep the process from ending.
        self._thread = threading.Thread(target=self._run, name="api", daemon=True)

    @property
    def counts(self) -> Counter[str]:
        """What was done with requests and connections, by reason."""
        return self._gate.counts + self._crowd.counts

    def start(self) -> None:
        """Begin to serve; who asks from now on is answered, if a little later."""
        self._socket.listen(BACKLOG)
        self._thread.start()

    def stop(self) -> None:
        """Answer what is asked, end the streams, and end."""
        self._bridge.closed = "teleop ends"
        self._server.should_exit = True
        self._thread.join(STOP_LIMIT)
        self._socket.close()

    def _run(self) -> None:
        self._server.run(sockets=[self._socket])


class _Server(uvicorn.Server):
    """Takes few connections at a time, and lets many wait; for asyncio both is one number."""

    async def startup(self, sockets: list[socket.socket] | None = None) -> None:
        """Begin to serve."""
        await super().startup(sockets)
        for each in sockets or []:
            each.listen(BACKLOG)


def _bound(address: Address) -> tuple[socket.socket, str]:
    """A socket bound at an address, and its URL."""
    if isinstance(address, Path):
        return _bound_file(address), f"unix:{address}"
    host, port = address
    family = socket.AF_INET6 if ":" in host else socket.AF_INET
    tcp = socket.socket(family, socket.SOCK_STREAM)
    tcp.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
    if host == "::":  # IPv4, too
        tcp.setsockopt(socket.IPPROTO_IPV6, socket.IPV6_V6ONLY, 0)
    try:
        tcp.bind((host, port))
    except OSError as error:
        tcp.close()
        text = f"--api {host}:{port}: {error.strerror or error}; choose another address"
        raise BadInputError(text) from error
    shown = f"[{host}]" if ":" in host else host
    return tcp, f"http://{shown}:{tcp.getsockname()[1]}"


def _bound_file(path: Path) -> socket.socket:
    """A Unix socket that its owner alone can connect to, from its first instant."""
    unix = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
    os.fchmod(unix.fileno(), 0o600)  # Linux gives the file the mode of the socket
    try:
        if path.is_socket():  # of a server before this one
            path.unlink()
        unix.bind(str(path))
    except OSError as error:
        unix.close()
        raise BadInputError(
            f"--api unix:{path}: {error.strerror or error}; choose another path"
        ) from error
    return unix
