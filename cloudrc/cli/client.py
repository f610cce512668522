"""The client of teleop's API: paths come in, JSON goes out, and errors become one sentence.

The API is at http://HOST:PORT, where every request carries a token, or at unix:PATH, a socket file
that its owner alone can open.

The token that a command sends to teleop's API: a flag comes in, the token's reader goes out.

It comes from a file, so that neither the process table nor a shell's history has it.
"""

from __future__ import annotations

import argparse
import http.client
import json
import os
import re
import socket
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any
from urllib.parse import quote, urlsplit

from cloudrc.cli.output import harmless
from cloudrc.errors import BadInputError, CloudrcError
from cloudrc.files import read

ANSWER_LIMIT = 10.0
"""For the API to answer one request [s]."""
STREAM_LIMIT = 30.0
"""Without a word from a stream it is dead [s]; alive it says something every 10 s."""
LATER = (408, 429, 502, 503, 504)
"""What is worth another try."""
UNIX = "unix:"


class ApiError(CloudrcError):
    """The API does not do what was asked."""

    exit_code = 5


class UnreachableError(ApiError):
    """The API does not answer, or not yet: to be tried again."""


class Api:
    """Teleop's API at one address."""

    def __init__(self, url: str, token: Callable[[], str] = lambda: "") -> None:
        """Ask nothing yet.

        Args:
            url: "http://HOST:PORT" or "unix:PATH".
            token: Asked with every request, since a token may change; "" for none.

        Raises:
            BadInputError: If it is no such address.
        """
        self.url, self._token = url.rstrip("/"), token
        parts = urlsplit(self.url)
        valid = parts.scheme in ("http", "https") and parts.hostname and not parts.username
        if not (valid or (url.startswith(UNIX) and len(url) > len(UNIX))):
            raise BadInputError(f"--api {url}: give http://HOST:PORT or unix:PATH")

    def get(self, path: str) -> Any:
        """Ask for something; raises as `post`."""
        return self._ask("GET", path)

    def post(self, path: str, body: Mapping[str, Any] | None = None) -> Any:
        """Ask for something to be done.

        Raises:
            UnreachableError: If nobody answers, or teleop is not ready or busy.
            BadInputError: If a value cannot be used.
            ApiError: If it is refused.
        """
        return self._ask("POST", path, b"" if body is None else json.dumps(body).encode())

    def events(self, after: int = 0) -> Iterator[dict[str, Any]]:
        """Give events as they happen, from the one after this number; ends when teleop ends.

        Raises:
            UnreachableError: If the stream breaks off.
        """
        connection, stream = self._open("GET", f"/v1/events?after={after}", None, STREAM_LIMIT)
        try:
            for line in stream:
                if line.startswith(b"data: "):
                    yield json.loads(line.removeprefix(b"data: "))
        except (OSError, http.client.HTTPException) as error:
            raise UnreachableError(f"the API at {self.url} broke off: {error}") from error
        finally:
            connection.close()

    def _ask(self, method: str, path: str, body: bytes | None = None) -> Any:
        connection, answer = self._open(method, path, body, ANSWER_LIMIT)
        try:
            return json.loads(answer.read())
        except (OSError, ValueError, http.client.HTTPException) as error:
            raise UnreachableError(f"no answer from the API at {self.url}: {error}") from error
        finally:
            connection.close()

    def _open(
        self, method: str, path: str, body: bytes | None, limit: float
    ) -> tuple[http.client.HTTPConnection, http.client.HTTPResponse]:
        connection = self._connection(limit)
        headers = {"Content-Type": "application/json"}
        token = self._token()
        if token:
            headers["Authorization"] = f"Bearer {token}"
        try:
            connection.request(method, path, body, headers)
            answer = connection.getresponse()
        except (OSError, http.client.HTTPException) as error:
            connection.close()
            why = getattr(error, "strerror", None) or error
            raise UnreachableError(f"the API at {self.url} does not answer ({why})") from None
        if answer.status >= 400:
            refusal = _refusal(answer, with_token=bool(token))
            connection.close()
            raise refusal
        return connection, answer

    def _connection(self, limit: float) -> http.client.HTTPConnection:
        """Not yet open; straight to the API: it is next door or in the cluster, no proxy is."""
        if self.url.startswith(UNIX):
            return _UnixConnection(Path(self.url.removeprefix(UNIX)), limit)
        parts = urlsplit(self.url)
        secure = parts.scheme == "https"
        kind = http.client.HTTPSConnection if secure else http.client.HTTPConnection
        return kind(parts.hostname or "", parts.port, timeout=limit)


def path_of(mission_id: str) -> str:
    """Where a mission is, whatever somebody has typed for its id."""
    return f"/v1/missions/{quote(mission_id, safe='', errors='surrogateescape')}"


class _UnixConnection(http.client.HTTPConnection):
    def __init__(self, path: Path, limit: float) -> None:
        super().__init__("localhost", timeout=limit)
        self._path = path

    def connect(self) -> None:
        self.sock = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
        self.sock.settimeout(self.timeout)
        self.sock.connect(str(self._path))


def _refusal(answer: http.client.HTTPResponse, *, with_token: bool) -> CloudrcError:
    try:
        said = json.loads(answer.read())
    except (OSError, ValueError, http.client.HTTPException):
        said = {}
    detail = said.get("detail") or f"the API answered {answer.status} {answer.reason}"
    detail = harmless(str(detail))
    problems = said.get("problems") or []
    if len(problems) > 1:
        told = ([p[k] for k in ("path", "value", "reason") if p[k]] for p in problems)
        lines = [harmless(": ".join(words)) for words in told]
        detail = "\n  ".join([f"the mission has {len(lines)} problems:", *lines])
    if answer.status in (400, 413, 422):
        return BadInputError(detail)
    if answer.status == 401:
        which = "does not know this token" if with_token else "wants a token"
        detail = f"the API {which}; name its file: --token-file FILE or CLOUDRC_TOKEN_FILE"
    return UnreachableError(detail) if answer.status in LATER else ApiError(detail)


VARIABLE = "CLOUDRC_TOKEN_FILE"
SIZE_MAX = 4096
"""Longest token file that is read [bytes]; it may end in blanks."""
_TOKEN = re.compile(r"[!-~]{16,512}")


def token_argument(parser: argparse.ArgumentParser) -> None:
    """Declare the flag."""
    parser.add_argument(
        "--token-file",
        type=Path,
        metavar="FILE",
        help=f"file with the API's token (default: that of {VARIABLE}, or the release's Secret)",
    )


def token_file(options: argparse.Namespace) -> Path | None:
    """Say which file has the token: the flag's, else the environment's, else none."""
    if options.token_file is not None:
        return Path(options.token_file)
    return Path(os.environ[VARIABLE]) if os.environ.get(VARIABLE) else None


def reader(path: Path | None) -> Callable[[], str]:
    """Give what reads the token from its file, every time, since it may change; "" without one."""
    return (lambda: "") if path is None else (lambda: _read(path))


def _read(path: Path) -> str:
    try:
        token = read(path, SIZE_MAX).decode("ascii").strip()
    except OSError as error:
        raise BadInputError(f"--token-file {path}: {error.strerror}; name a file") from None
    except ValueError:
        token = ""
    if not _TOKEN.fullmatch(token):
        raise BadInputError(f"--token-file {path}: holds no token; name another file")
    return token
