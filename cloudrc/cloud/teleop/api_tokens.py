"""Who may do what: a folder of token files and a request's header come in, a role goes out.

Only digests of the tokens are kept: nothing that this process shows, logs or leaves in a core file
holds a token. The files are read again when they change, so a Secret can be rotated in flight.
"""

from __future__ import annotations

import hashlib
import hmac
import re
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Literal, TypeAlias

from cloudrc.errors import BadInputError, CloudrcError
from cloudrc.files import read, version

Role: TypeAlias = Literal["operator", "reader"]
OPERATOR: Role = "operator"
READER: Role = "reader"
ROLES: tuple[Role, ...] = (OPERATOR, READER)
"""A token file has the name of its role. Operators may do everything, readers may look."""

LOOK_PERIOD = 1.0
"""Between two looks whether the files have changed [s]."""
SIZE_MAX = 4096
"""Of a token file [bytes]: whitespace around the token is passed over."""
_TOKEN = re.compile(rb"[!-~]{16,512}")
_BEARER = b"bearer "


class RevokedError(CloudrcError):
    """The token of a request is taken away while its body arrives."""


@dataclass(frozen=True, slots=True)
class Caller:
    """Somebody who is known.

    Attributes:
        role: What they may do.
        name: Tells their token from others without giving it away.
    """

    role: Role
    name: str


LOCAL = Caller(OPERATOR, "local")
"""Who can open a socket file that its owner alone can open."""


class Tokens:
    """The tokens of a folder; `repr` shows none."""

    def __init__(self, folder: Path) -> None:
        """Read them.

        Args:
            folder: Has a file `operator` and, if there shall be such a role, `reader`.

        Raises:
            BadInputError: If one cannot be used; its text has no token in it.
        """
        self._folder = folder
        self._state, self._looked = self._look(), time.monotonic()  # first: what changes since
        self._known = self._read()

    def caller(self, header: bytes | None) -> Caller | None:
        """Say who sends this Authorization header; None if nobody who is known."""
        self._follow()
        if header is None or header[: len(_BEARER)].lower() != _BEARER:
            return None
        given = hashlib.sha256(header[len(_BEARER) :].strip()).digest()
        found = None
        for digest, caller in self._known:  # all of them, so that time tells nothing
            if hmac.compare_digest(digest, given):
                found = caller
        return found

    def _follow(self) -> None:
        """Read the files again if they have changed; one that cannot be used admits nobody."""
        now = time.monotonic()
        if now - self._looked < LOOK_PERIOD:
            return
        self._looked, state = now, self._look()
        if state == self._state:
            return
        self._state = state
        try:
            self._known = self._read()
        except BadInputError:
            self._known = ()

    def _look(self) -> list[tuple[int, int, int] | None]:
        return [version(self._folder / role) for role in ROLES]

    def _read(self) -> tuple[tuple[bytes, Caller], ...]:
        known = []
        for role in ROLES:
            path = self._folder / role
            if role == READER and not path.exists():
                continue
            digest = hashlib.sha256(_read_token(path)).digest()
            known.append((digest, Caller(role, f"{role}-{digest.hex()[:8]}")))
        if len({digest for digest, _ in known}) < len(known):
            raise BadInputError(f"--tokens {self._folder}: both roles have the same token")
        return tuple(known)


def _read_token(path: Path) -> bytes:
    make = f"make one: openssl rand -hex 32 > {path}"
    try:
        token = read(path, SIZE_MAX).strip()
    except OSError as error:
        raise BadInputError(f"--tokens: {path}: {error.strerror}; {make}") from None
    except ValueError as error:  # which names the file
        raise BadInputError(f"--tokens: {error}; remove it and {make}") from None
    if not _TOKEN.fullmatch(token):
        raise BadInputError(
            f"--tokens: {path}: a token is 16 to 512 visible ASCII characters; {make}"
        )
    return token
