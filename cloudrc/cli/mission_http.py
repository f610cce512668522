"""The client of teleop's API: paths come in, JSON goes out, and errors become one sentence."""

from __future__ import annotations

import json
import urllib.error
import urllib.request
from collections.abc import Iterator, Mapping
from typing import Any

from cloudrc.errors import BadInputError, CloudrcError

ANSWER_LIMIT = 10.0
"""For the API to answer one request [s]."""
STREAM_LIMIT = 30.0
"""Without a word from a stream it is dead [s]; alive it says something every 10 s."""


class ApiError(CloudrcError):
    """The API does not do what was asked."""

    exit_code = 5


class UnreachableError(ApiError):
    """The API does not answer, or not yet: to be tried again."""


class Api:
    """Teleop's API at one address."""

    def __init__(self, url: str) -> None:
        """Ask nothing yet.

        Args:
            url: "http://HOST:PORT".

        Raises:
            BadInputError: If it is no such address.
        """
        if not url.startswith(("http://", "https://")):
            raise BadInputError(f"--api {url}: give http://HOST:PORT")
        self.url = url.rstrip("/")
        # The API is next door or in the cluster: no proxy leads there.
        self._opener = urllib.request.build_opener(urllib.request.ProxyHandler({}))

    def get(self, path: str) -> Any:
        """Ask for something; raises as `post`."""
        return self._ask(urllib.request.Request(self.url + path))

    def post(self, path: str, body: Mapping[str, Any] | None = None) -> Any:
        """Ask for something to be done.

        Raises:
            UnreachableError: If nobody answers, or teleop is not ready.
            BadInputError: If a value cannot be used.
            ApiError: If it is refused.
        """
        data = b"" if body is None else json.dumps(body).encode()
        headers = {"Content-Type": "application/json"}
        return self._ask(urllib.request.Request(self.url + path, data, headers, method="POST"))

    def events(self, after: int = 0) -> Iterator[dict[str, Any]]:
        """Give events as they happen, from the one after this number; ends when teleop ends.

        Raises:
            UnreachableError: If the stream breaks off.
        """
        request = urllib.request.Request(f"{self.url}/v1/events?after={after}")
        with self._open(request, STREAM_LIMIT) as stream:
            try:
                for line in stream:
                    if line.startswith(b"data: "):
                        yield json.loads(line.removeprefix(b"data: "))
            except OSError as error:
                raise UnreachableError(f"the API at {self.url} broke off: {error}") from error

    def _ask(self, request: urllib.request.Request) -> Any:
        with self._open(request, ANSWER_LIMIT) as answer:
            try:
                return json.loads(answer.read())
            except (OSError, ValueError) as error:
                raise UnreachableError(f"no answer from the API at {self.url}: {error}") from error

    def _open(self, request: urllib.request.Request, timeout: float) -> Any:
        try:
            return self._opener.open(request, timeout=timeout)
        except urllib.error.HTTPError as error:
            raise _refusal(error) from None
        except (urllib.error.URLError, OSError) as error:
            why = getattr(error, "reason", error)
            raise UnreachableError(
                f"the API at {self.url} does not answer ({getattr(why, 'strerror', why) or why})"
            ) from None


def _refusal(error: urllib.error.HTTPError) -> CloudrcError:
    try:
        said = json.loads(error.read())
    except (OSError, ValueError):
        said = {}
    detail = str(said.get("detail") or f"the API answered {error.code} {error.reason}")
    problems = said.get("problems") or []
    if len(problems) > 1:
        lines = [": ".join(p[k] for k in ("path", "value", "reason") if p[k]) for p in problems]
        detail = "\n  ".join([f"the mission has {len(lines)} problems:", *lines])
    if error.code in (400, 413, 422):
        return BadInputError(detail)
    return UnreachableError(detail) if error.code in (502, 503, 504) else ApiError(detail)
