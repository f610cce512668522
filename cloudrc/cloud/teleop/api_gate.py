"""The gate before the API: every request comes in; those of known callers, and few enough, go on.

Denied by default: whatever the path, without a valid token it is 401, and with a reader's token
everything but looking is 403. A flood of either is answered with 429 and reaches nothing. Behind
the gate are the routes. An operator's emergency stop has a lane of its own: it alone, by path and
method, is never counted against anybody's room.
"""

from __future__ import annotations

import json
import time
from collections import Counter
from collections.abc import Awaitable, Callable, MutableMapping
from dataclasses import dataclass
from typing import Any, TypeAlias

from cloudrc.cloud.teleop.api_audit import Audit
from cloudrc.cloud.teleop.api_bridge import LANE
from cloudrc.cloud.teleop.api_tokens import LOCAL, OPERATOR, Caller, RevokedError, Tokens

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
