# SPDX-License-Identifier: Apache-2.0

"""Check the bearer token of every API request, count requests, and log commands.

A caller with an operator's token may do everything; a caller with a reader's token may only read.
"""

from __future__ import annotations

import asyncio
import hashlib
import json
from collections import Counter
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

from fastapi.responses import JSONResponse
from fastapi.security import HTTPBearer
from starlette.requests import Request
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from cloudrc.base.errors import CloudrcError, to_one_line
from cloudrc.base.files import warn_if_readable
from cloudrc.base.outside.paths import read_tokens

OPERATOR, READER = "operator", "reader"
"""Roles of callers; the token of a role is in a file with the name of the role."""
BEARER = HTTPBearer(auto_error=False, description="An operator's token, or a reader's for GET")
READS = ("GET", "HEAD")
URGENT = ("/v1/estop", "/v1/hold")
"""Paths of commands that are accepted even if too many requests are open."""
REPEATED = ("/drive", "/renew")
"""Ends of the paths of requests that a program repeats: to drive, to renew a mission's lease. Of
these requests, the log contains only the refused ones."""
ORDERS = ("/v1/missions", "/v1/goto")
"""Paths of orders to fly a mission or to a point; refused orders are counted by reason."""
COUNTED = {409: "order_conflict", 413: "order_invalid", 422: "order_invalid"}
"""HTTP status of a refused order -> name of the counter."""
REFUSED = {
    401: ("token", "a valid token is needed: Authorization: Bearer TOKEN"),
    403: ("role", "this token may look, not command: an operator's is needed"),
    429: ("busy", "too many requests; try again in a second"),
}
"""HTTP status of a refused request -> name of the counter, and text of the answer."""
HEADERS = {401: {"WWW-Authenticate": "Bearer"}, 429: {"Retry-After": "1"}}
SEND_LIMIT = 30.0
"""Time for a client to read before its request ends [s]; a client that stalls keeps no slot."""
IN_FLIGHT_MAX = 32
"""Largest number of requests of one role that are answered at the same time, streams included."""


class Caller(NamedTuple):
    """An authenticated caller: the role, and a name that does not reveal the token."""

    role: str
    name: str


LOCAL = Caller(OPERATOR, "local")
"""Caller that connects through a Unix socket, which only the owner of its file can open."""


class Tokens:
    """Hashes of the tokens in a folder: file `operator`, and file `reader` if it exists."""

    def __init__(self, folder: Path, warn: Callable[[str], None] = lambda text: None) -> None:
        """Read the tokens; `warn` receives one line for each file that other users can read."""
        self._folder = folder
        self._read()
        for role in (OPERATOR, READER):
            warn_if_readable(folder / role, warn)

    def caller(self, token: str) -> Caller | None:
        """Return the caller with this token; None if the token is not valid.

        Each call reads the files of operator and reader again. While one of them contains no valid
        token, no token is valid.
        """
        try:
            return self._read().get(hashlib.sha256(token.encode()).digest())
        except CloudrcError:
            return None

    def _read(self) -> dict[bytes, Caller]:
        known: dict[bytes, Caller] = {}
        for token, role in read_tokens(self._folder, (OPERATOR, READER)).items():
            digest = hashlib.sha256(token.encode()).digest()
            known[digest] = Caller(role, f"{role}-{digest.hex()[:8]}")
        return known


class Gate:
    """Check token and role of every request before the application gets the request."""

    def __init__(self, app: ASGIApp, tokens: Tokens | None, log: Callable[[str], None]) -> None:
        """Set the application; without `tokens`, all who can connect may command.

        `log` receives a line for each command: who sent it, from where, what, and the answer.
        """
        self._app, self.tokens, self._log = app, tokens, log
        self._in_flight: Counter[str] = Counter()
        self.counts: Counter[str] = Counter()  # requests by outcome; "served": answered by `app`

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Refuse a request, or pass it on to the application; remove a slash at the path's end."""
        path = scope["path"] = scope["path"].rstrip("/") or "/"
        # A stream calls `caller` again, because it can outlast its token.
        caller, scope["caller"] = await self.caller(scope), lambda: self.caller(scope)
        is_command = scope["method"] not in READS
        status = self._refusal(caller, is_urgent=path in URGENT, is_command=is_command)
        if caller is None or status:
            reason, detail = REFUSED[status]
            self.counts[reason] += 1
            refusal = JSONResponse({"detail": detail}, status, HEADERS.get(status))
            await refusal(scope, receive, send)
            return
        answer: Message = {"status": 500}

        async def keep(message: Message) -> None:
            answer.update(message)
            async with asyncio.timeout(SEND_LIMIT):
                await send(message)

        self._in_flight[caller.role] += 1
        try:
            await self._app(scope, receive, keep)
        finally:
            status = answer["status"]
            self._in_flight[caller.role] -= 1
            self.counts["served"] += 1
            if path in ORDERS and status in COUNTED:
                self.counts[COUNTED[status]] += 1
            if is_command and not (path.endswith(REPEATED) and status == 200):
                said = json.loads(answer.get("body") or b"{}")
                where = ":".join(map(str, scope.get("client") or ("local",)))
                told = said.get("id") or "", said.get("detail") or said.get("state") or ""
                line = f"{caller.name} {where} {scope['method']} {path[:200]}: {status}"
                self._log(to_one_line(" ".join((line, *told))))

    async def caller(self, scope: Scope) -> Caller | None:
        """Return the caller of a request; None without a valid token."""
        if self.tokens is None:
            return LOCAL
        sent = await BEARER(Request(scope))
        return None if sent is None else self.tokens.caller(sent.credentials)

    def _refusal(self, caller: Caller | None, *, is_urgent: bool, is_command: bool) -> int:
        """Return the HTTP status with which to refuse a request; 0 to serve the request."""
        if caller is None:
            return 401
        if is_command and caller.role != OPERATOR:
            return 403
        is_full = self._in_flight[caller.role] >= IN_FLIGHT_MAX
        return 429 if is_full and not (is_command and is_urgent) else 0
