# SPDX-License-Identifier: Apache-2.0

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
from hashlib import sha256
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from starlette.requests import HTTPConnection

LOCAL_HOST = re.compile(r"(127\.0\.0\.1|localhost)(:[0-9]{1,5})?")
"""The console's own address. The port is free: a tunnel may forward another one."""
ORIGIN = re.compile(r"https?://([a-z0-9.-]+|\[[0-9a-f:.]+\])(:[0-9]{1,5})?")
"""An origin as browsers write it: lower case, no path, no slash at the end."""
PARAMETER = "token"
"""Parameter of the address that has the token."""


class Access:
    """The rules of one console.

    Attributes:
        token: Function that returns the present token.
        origins: Origins besides the console's own, such as "https://hub.example.org".
    """

    def __init__(self, token: Callable[[], str], origins: Collection[str] = ()) -> None:
        self.token, self.origins = token, frozenset(origins)
        self._hosts = {origin.partition("://")[2] for origin in origins}

    def is_own_page(self, request: HTTPConnection) -> bool:
        """Return whether the request comes from the console's page or from no page at all."""
        hosts, origins = (request.headers.getlist(name) for name in ("host", "origin"))
        if len(hosts) != 1 or len(origins) > 1:
            return False
        host = hosts[0]
        is_local = LOCAL_HOST.fullmatch(host) is not None
        if not (is_local or host in self._hosts):
            return False
        own = {f"http://{host}"} if is_local else set()
        return not origins or origins[0] in own | self.origins

    def has_token(self, request: HTTPConnection) -> bool:
        """Return whether the address has the token, or has none and the cookie has it."""
        query = request.scope["query_string"].decode("latin-1").split("&")
        given = _values(query, PARAMETER)
        if not given:
            cookies = ";".join(request.headers.getlist("cookie")).split(";")
            given = _values([each.strip(" ") for each in cookies], self.cookie)
        token = self.token().encode()
        return bool(given) and all(hmac.compare_digest(each.encode(), token) for each in given)

    @property
    def cookie(self) -> str:
        """The name of the cookie. It differs between consoles: cookies ignore the port."""
        return f"cloudrc-{sha256(self.token().encode()).hexdigest()[:12]}"


def _values(pairs: list[str], name: str) -> list[str]:
    """Return the values with this name of all pairs NAME=VALUE, as they are written."""
    parts = (pair.partition("=") for pair in pairs)
    return [value for key, _, value in parts if key == name]


def page_token(secret: str) -> str:
    """Derive the token of a release's page from the operator's token of the release's API.

    Whoever has the operator's token can compute it. The page's token does not open the API.
    """
    return hmac.new(secret.encode(), b"cloudrc console", sha256).hexdigest()[:32]
