"""Who may do what: a folder of token files and a request's header come in, a role goes out.

Only digests of the tokens are kept: nothing that this process shows, logs or leaves in a core file
holds a token. The files are read again when they change, so a Secret can be rotated in flight.

The audit log: who commanded what, and what became of it; one line of JSON each, never a token.

Requests do not wait for the disk: lines are written by a thread of its own, in order. What a slow
disk makes too many is dropped and counted. The file is cut in two by size, so that it cannot fill
the volume that the journal needs. What readers are refused is written down now and then only, or it
would push what operators did out of both files.
"""

from __future__ import annotations

import hashlib
import hmac
import json
import os
import queue
import re
import threading
import time
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, Literal, TypeAlias

from cloudrc.errors import BadInputError, CloudrcError
from cloudrc.files import read, version

Role: TypeAlias = Literal["operator", "reader"]
OPERATOR: Role = "operator"
READER: Role = "reader"
ROLES: tuple[Role, ...] = (OPERATOR, READER)
"""A token file has the name of its role. Operators may do everything, readers may look."""

LOOK_PERIOD = 1.0
"""Between two looks whether the files have changed [s]."""
TOKEN_SIZE_MAX = 4096
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
        token = read(path, TOKEN_SIZE_MAX).strip()
    except OSError as error:
        raise BadInputError(f"--tokens: {path}: {error.strerror}; {make}") from None
    except ValueError as error:  # which names the file
        raise BadInputError(f"--tokens: {error}; remove it and {make}") from None
    if not _TOKEN.fullmatch(token):
        raise BadInputError(
            f"--tokens: {path}: a token is 16 to 512 visible ASCII characters; {make}"
        )
    return token


WAITING_MAX = 1_000
"""Lines that wait for the disk."""
AUDIT_SIZE_MAX = 8 << 20
"""Of the file [bytes]; then it is renamed, in the place of the one before it, or grows no more."""
STOP_LIMIT = 1.0
"""For the last lines to be written [s]."""


class Audit:
    """An audit log that is written while it is open.

    Attributes:
        dropped: How many lines were not written.
    """

    def __init__(
        self,
        path: Path | None,
        complain: Callable[[str], None] = lambda text: None,
        size_max: int = AUDIT_SIZE_MAX,
    ) -> None:
        """Begin.

        Args:
            path: Where to; None for nowhere.
            complain: Gets one line when it cannot be written, once.
            size_max: When to begin a new file [bytes].
        """
        self.dropped = 0
        self._path, self._complain, self._size_max = path, complain, size_max
        self._waiting: queue.Queue[bytes | None] = queue.Queue(WAITING_MAX)
        self._left_out = 0
        self._troubled = False
        self._writing = 0  # lines that the disk is given just now
        self._thread = threading.Thread(target=self._write_all, name="audit", daemon=True)
        if path is not None:
            self._thread.start()

    def note(self, **what: Any) -> None:
        """Write down what somebody commanded, with the time; never waits."""
        self._tell_left_out()
        self._put(what)

    def leave_out(self) -> None:
        """Count what is not worth a line of its own; the next line says how many there were."""
        self._left_out += 1

    def _tell_left_out(self) -> None:
        if self._left_out:
            self._put({"left_out": self._left_out, "outcome": "refused, and not written down each"})
            self._left_out = 0

    def _put(self, what: dict[str, Any]) -> None:
        if self._path is None:
            return
        now = datetime.fromtimestamp(time.time(), UTC).isoformat(timespec="milliseconds")
        line = json.dumps({"time": now, **what}, separators=(",", ":")).encode() + b"\n"
        try:
            self._waiting.put_nowait(line)
        except queue.Full:
            self.dropped += 1

    def close(self) -> None:
        """Write what waits, and end; what a disk that hangs does not take is given up."""
        if self._path is None:
            return
        self._tell_left_out()
        with suppress(queue.Full):
            self._waiting.put(None, timeout=STOP_LIMIT)
        self._thread.join(STOP_LIMIT)
        if self._thread.is_alive():
            self._give_up()

    def _give_up(self) -> None:
        lost, self._writing = self._writing, 0
        with suppress(queue.Empty):
            while True:
                lost += self._waiting.get_nowait() is not None
        self._waiting.put_nowait(None)  # should the disk come back
        self.dropped += lost
        if lost:
            self._complain(f"the audit log {self._path}: the disk hangs; {lost} lines are lost")

    def _write_all(self) -> None:
        assert self._path is not None, "the thread is started for a file"
        ends = False
        while not ends:
            lines = [self._waiting.get()]
            while not self._waiting.empty():
                lines.append(self._waiting.get())
            ends = None in lines
            data = [line for line in lines if line is not None]
            self._writing = len(data)
            try:
                self._write(self._path, b"".join(data))
                self._troubled = False
            except OSError as error:
                self.dropped += len(data)
                if not self._troubled:
                    self._complain(f"the audit log {self._path} cannot be written: {error}")
                self._troubled = True
            self._writing = 0

    def _write(self, path: Path, data: bytes) -> None:
        with suppress(FileNotFoundError):
            if path.stat().st_size > self._size_max:
                path.replace(path.with_name(f"{path.name}.1"))
        # Unbuffered, since what a full disk has torn must not be tried again by `close`.
        with open(path, "ab", buffering=0, opener=_private) as file:
            began = file.tell()
            try:
                while data:
                    data = data[file.write(data) or 0 :]
                os.fsync(file.fileno())
            except OSError:
                with suppress(OSError):
                    file.truncate(began)  # half a line would swallow the next one
                raise


def _private(path: str, flags: int) -> int:
    return os.open(path, flags, 0o600)
