"""Admit callers to the API by bearer token, and count their requests.

A caller with an operator's token may do everything; a caller with a reader's token may only read.
Memory holds only digests of tokens. The limit on simultaneous requests never refuses an operator's
emergency stop or hold.
"""

from __future__ import annotations

import hashlib
import hmac
import re
import time
from collections import Counter
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import NamedTuple

from fastapi.responses import JSONResponse
from fastapi.security import HTTPBearer
from starlette.requests import Request
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from cloudrc.errors import BadInputError
from cloudrc.files import read, readable_by_others
from cloudrc.teleop.audit import Audit
from cloudrc.teleop.bridge import WAITING_MAX

OPERATOR, READER = "operator", "reader"
"""Roles; the name of a token file is its role."""
BEARER = HTTPBearer(auto_error=False, description="An operator's token, or a reader's for GET")
READ_PERIOD = 1.0
"""Time after which the token files are read again [s]."""
TOKEN_SIZE_MAX = 4096
"""Largest token file [bytes], including white space around the token."""
_TOKEN = re.compile(rb"[!-~]{16,512}")

READS = ("GET", "HEAD")
URGENT = ("/v1/estop", "/v1/hold")
"""Commands that the limit on simultaneous requests never refuses."""
ORDERS = ("/v1/missions", "/v1/goto")
"""Commands whose refusals are counted: orders to fly a mission or to fly to a point."""
COUNTED = {409: "order_conflict", 413: "order_invalid", 422: "order_invalid"}
"""HTTP status of a refused order -> name under which it is counted."""
IN_FLIGHT_MAX = WAITING_MAX // 2
"""Limit of the requests of one role that are answered at the same time, including streams. So
readers cannot use up the operators' room on the bridge."""


class Caller(NamedTuple):
    """A known caller: role, and name of the token; the name does not reveal the token."""

    role: str
    name: str


LOCAL = Caller(OPERATOR, "local")
"""The caller through a socket file, which only its owner can open."""


class Tokens:
    """The tokens in a folder: the file `operator` and, if there are readers, the file `reader`."""

    def __init__(self, folder: Path, warn: Callable[[str], None] = lambda text: None) -> None:
        """Read the tokens; `warn` receives one line for each file that other users can read.

        Raises:
            BadInputError: If a file cannot be used; the text does not contain the token.
        """
        self._folder, self._read_at = folder, time.monotonic()
        self._known = self._read()
        for path in (folder / OPERATOR, folder / READER):
            if readable_by_others(path):
                warn(f"warning: {path} can be read by others: chmod 600 {path}")

    def caller(self, token: str) -> Caller | None:
        """Return the caller with this token; None for unknown tokens or if a file is unusable."""
        if time.monotonic() - self._read_at >= READ_PERIOD:
            self._read_at, self._known = time.monotonic(), {}
            with suppress(BadInputError):
                self._known = self._read()
        given, found = hashlib.sha256(token.encode()).digest(), None
        for digest, caller in self._known.items():  # all of them, so that the time reveals nothing
            if hmac.compare_digest(digest, given):
                found = caller
        return found

    def _read(self) -> dict[bytes, Caller]:
        known: dict[bytes, Caller] = {}
        for role in (OPERATOR, READER):
            path = self._folder / role
            if role == OPERATOR or path.exists():
                digest = hashlib.sha256(_read_token(path)).digest()
                if digest in known:
                    raise BadInputError(f"--tokens {self._folder}: both roles have the same token")
                known[digest] = Caller(role, f"{role}-{digest.hex()[:8]}")
        return known


def _read_token(path: Path) -> bytes:
    make = f"make one: (umask 077; openssl rand -hex 32 > {path})"
    try:
        token = read(path, TOKEN_SIZE_MAX).strip()
    except OSError as error:
        raise BadInputError(f"--tokens: {path}: {error.strerror}; {make}") from None
    except ValueError as error:  # names the file
        raise BadInputError(f"--tokens: {error}; remove it and {make}") from None
    if not _TOKEN.fullmatch(token):
        raise BadInputError(
            f"--tokens: {path}: a token is 16 to 512 visible ASCII characters; {make}"
        )
    return token


class Gate:
    """Admit callers to an application; the check covers every path.

    Attributes:
        tokens: The known tokens; None if everybody who can connect may command.
        audit: Logs operators' commands; None without a log.
        counts: Number of requests by outcome; "served" means that the application has answered.
    """

    def __init__(self, app: ASGIApp, tokens: Tokens | None, audit: Audit | None = None) -> None:
        """Protect an application."""
        self._app, self.tokens, self.audit = app, tokens, audit
        self._in_flight: Counter[str] = Counter()
        self.counts: Counter[str] = Counter()

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Answer one request; ignore a slash at the end of its path."""
        scope["path"] = path = scope["path"].rstrip("/") or "/"
        caller, is_command = await self.caller(scope), scope["method"] not in READS
        if caller is None:
            detail = "a valid token is needed: Authorization: Bearer TOKEN"
            await self._refuse("token", 401, detail)(scope, receive, send)
        elif is_command and caller.role != OPERATOR:
            detail = "this token may look, not command: an operator's is needed"
            await self._refuse("role", 403, detail)(scope, receive, send)
        elif is_command and path in URGENT:
            await self._serve(caller, scope, receive, send)
        elif self._in_flight[caller.role] >= IN_FLIGHT_MAX:
            detail = "too many requests; try again in a second"
            await self._refuse("busy", 429, detail)(scope, receive, send)
        else:
            self._in_flight[caller.role] += 1
            try:
                await self._serve(caller, scope, receive, send)
            finally:
                self._in_flight[caller.role] -= 1

    async def caller(self, scope: Scope) -> Caller | None:
        """Return the caller of a request; None if the caller is unknown."""
        if self.tokens is None:
            return LOCAL
        sent = await BEARER(Request(scope))
        return None if sent is None else self.tokens.caller(sent.credentials)

    def _refuse(self, reason: str, status: int, detail: str) -> JSONResponse:
        self.counts[reason] += 1
        headers = {401: {"WWW-Authenticate": "Bearer"}, 429: {"Retry-After": "1"}}.get(status)
        return JSONResponse({"detail": detail}, status, headers)

    async def _serve(self, caller: Caller, scope: Scope, receive: Receive, send: Send) -> None:
        """Pass a request on, count it, and log the result if it is a command."""
        answer: Message = {"status": 500}

        async def keep(message: Message) -> None:
            answer.update(message)
            await send(message)

        scope["caller"] = lambda: self.caller(scope)  # for a stream, which may outlive its token
        try:
            await self._app(scope, receive, keep)
        finally:
            self.counts["served"] += 1
            self.counts["slow"] += answer["status"] == 408
            if scope["path"] in ORDERS and answer["status"] in COUNTED:
                self.counts[COUNTED[answer["status"]]] += 1
            if self.audit is not None and scope["method"] not in READS:
                self.audit.note(*caller, scope, answer)
