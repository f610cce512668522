"""Decide which requests the console answers: those of its own page, by a user who has the token.

A browser lets every web page send requests to this machine, but it tells whose page sends them
(`Origin`) and which name the user has typed (`Host`). A page of somebody else has a foreign origin.
A page that gives its own name this machine's address (DNS rebinding) has a foreign host. Other
users of this machine can send any header, but do not have the token.
"""

from __future__ import annotations

import hmac
import re
from collections.abc import Callable, Collection
from dataclasses import dataclass
from hashlib import sha256

LOCAL_HOST = re.compile(r"(127\.0\.0\.1|localhost)(:[0-9]{1,5})?")
"""The console's own address. The port is free: a tunnel may forward another one."""
ORIGIN = re.compile(r"https?://([a-z0-9.-]+|\[[0-9a-f:.]+\])(:[0-9]{1,5})?")
"""An origin as browsers write it: lower case, no path, no slash at the end."""
PARAMETER = "token"
"""Parameter of the address that has the token."""
_NAME = re.compile(r"[!#$%&'*+.^_`|~0-9A-Za-z-]+")
_FIRST_LINE = re.compile(rf"({_NAME.pattern}) (/[!->@-~]*)(?:\?([!-~]*))? HTTP/1\.1")
_LINE = re.compile(r"[\t -~\x80-\xff]*")


@dataclass(frozen=True)
class PageRequest:
    """The head of an HTTP request."""

    method: str
    path: str
    query: str  # of the address, without "?"
    headers: tuple[tuple[str, str], ...]  # name in lower case, value

    def values(self, name: str) -> list[str]:
        """Return the values of all headers with this name, in lower case."""
        return [value for key, value in self.headers if key == name]

    @property
    def is_websocket(self) -> bool:
        """Whether the client asks for a WebSocket."""
        return [value.lower() for value in self.values("upgrade")] == ["websocket"]


def parse_head(head: bytes) -> PageRequest:
    """Parse the head of an HTTP request, without the empty line at its end.

    Raises:
        ValueError: If it is not valid, or older than HTTP/1.1.
    """
    first, *lines = head.decode("latin-1").split("\r\n")
    found = _FIRST_LINE.fullmatch(first)
    if found is None:
        raise ValueError("no request")
    method, path, query = found.groups(default="")
    headers = []
    for line in lines:
        name, colon, value = line.partition(":")
        if not (colon and _NAME.fullmatch(name) and _LINE.fullmatch(value)):
            raise ValueError("no request: a line is not a header")
        headers.append((name.lower(), value.strip("\t ")))
    return PageRequest(method, path, query, tuple(headers))


class Access:
    """The rules of one console.

    Attributes:
        token: Function that returns the present token.
        origins: Origins besides the console's own, such as "https://hub.example.org".
    """

    def __init__(self, token: Callable[[], str], origins: Collection[str] = ()) -> None:
        self.token, self.origins = token, frozenset(origins)
        self._hosts = {origin.partition("://")[2] for origin in origins}

    def is_own_page(self, request: PageRequest) -> bool:
        """Return whether the request comes from the console's page or from no page at all."""
        hosts, origins = request.values("host"), request.values("origin")
        if len(hosts) != 1 or len(origins) > 1:
            return False
        host = hosts[0]
        is_local = LOCAL_HOST.fullmatch(host) is not None
        if not (is_local or host in self._hosts):
            return False
        own = {f"http://{host}"} if is_local else set()
        return not origins or origins[0] in own | self.origins

    def has_token(self, request: PageRequest) -> bool:
        """Return whether the address has the token, or has none and the cookie has it."""
        given = self.given_tokens(request) or self._cookies(request)
        return bool(given) and all(self._is_token(each) for each in given)

    def given_tokens(self, request: PageRequest) -> list[str]:
        """Return the tokens in the request's address, as they are written there."""
        pairs = (part.partition("=") for part in request.query.split("&"))
        return [value for name, _, value in pairs if name == PARAMETER]

    @property
    def cookie(self) -> str:
        """The name of the cookie. It differs between consoles: cookies ignore the port."""
        return f"cloudrc-{sha256(self.token().encode()).hexdigest()[:12]}"

    def _cookies(self, request: PageRequest) -> list[str]:
        pairs = (
            part.strip(" ").partition("=")
            for line in request.values("cookie")
            for part in line.split(";")
        )
        return [value for name, _, value in pairs if name == self.cookie]

    def _is_token(self, given: str) -> bool:
        return hmac.compare_digest(given.encode(), self.token().encode())


def page_token(secret: str) -> str:
    """Derive the token of a release's page from the operator's token of the release's API.

    Whoever has the operator's token can compute it. The page's token does not open the API.
    """
    return hmac.new(secret.encode(), b"cloudrc console", sha256).hexdigest()[:32]
