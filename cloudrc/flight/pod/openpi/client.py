# SPDX-License-Identifier: Apache-2.0

"""Ask a policy's server over a WebSocket."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, NoReturn

from websockets.exceptions import ConnectionClosed, InvalidHandshake, InvalidStatus, InvalidURI
from websockets.sync.client import connect
from websockets.sync.connection import Connection

from cloudrc.base.errors import CloudrcError, describe_error, to_one_line
from cloudrc.flight.pod.openpi import KEY_VARIABLE
from cloudrc.flight.pod.openpi.codec import MESSAGE_MAX, WireError, pack, unpack

START_LIMIT = 60.0
"""Time limit for the metadata and for the first answer of a server [s]: it loads weights."""
ANSWER_LIMIT = 30.0
"""Time limit for each further answer [s]."""
CLOSE_LIMIT = 0.5
"""Time for which a client waits for the server's end of a connection [s]."""


class PolicyServerError(CloudrcError):
    """A policy's server does not answer, or its answer is wrong."""

    exit_code = 5


class SilentServerError(PolicyServerError):
    """A policy's server does not listen, has closed the connection, or did not answer in time."""


class PolicyClient:
    """One connection to a policy's server.

    After a failure, also a late answer, the connection is closed: the answer would be taken for
    that of the next observation.

    Attributes:
        url: Address of the server.
        metadata: What the server has said about itself.
    """

    def __init__(
        self,
        url: str,
        *,
        key: str = "",
        start_limit: float = START_LIMIT,
        answer_limit: float = ANSWER_LIMIT,
    ) -> None:
        """Connect, and read the metadata.

        Args:
            url: Address of the server, such as ws://127.0.0.1:8000.
            key: API key; "" for none.
            start_limit: Time limit for the metadata and for the first answer [s].
            answer_limit: Time limit for each further answer [s].
        """
        self.url, self._limit, self._answer_limit = url, start_limit, answer_limit
        self._connection: Connection | None = self._connect(key)
        self.metadata = self._receive("metadata")

    def __enter__(self) -> PolicyClient:
        return self

    def __exit__(self, *failure: object) -> None:
        self.close()

    def infer(self, observation: Mapping[str, Any]) -> dict[Any, Any]:
        """Send an observation and return the answer; raise a PolicyServerError without one."""
        if self._connection is None:
            raise SilentServerError(f"{self.url}: the connection is closed; connect again")
        self._find_early_answer()
        try:
            self._connection.send(pack(observation))
        except ConnectionClosed:
            pass  # the server may have said why: an error's text is still to be read
        except WireError as error:
            raise PolicyServerError(f"{self.url}: {error}") from None
        answer = self._receive("answer")
        self._limit = self._answer_limit
        return answer

    def _find_early_answer(self) -> None:
        """Raise a PolicyServerError if the server has sent more than one answer per observation.

        Its answers would be taken for those of later observations.
        """
        assert self._connection is not None
        try:
            frame = self._connection.recv(timeout=0)
        except (TimeoutError, ConnectionClosed):
            return
        self._fail_with(frame if isinstance(frame, str) else "an answer to no observation")

    def close(self) -> None:
        """Close the connection."""
        connection, self._connection = self._connection, None
        if connection is not None:
            connection.close()

    def _connect(self, key: str) -> Connection:
        try:
            return connect(
                self.url,
                additional_headers={"Authorization": f"Api-Key {key}"} if key else None,
                compression=None,
                max_size=MESSAGE_MAX,
                open_timeout=self._limit,
                close_timeout=CLOSE_LIMIT,
                ping_interval=None,  # a server that computes answers no ping
                proxy=None,
            ).__enter__()  # else version 17 warns; `close` does what `__exit__` would
        except ConnectionError as error:
            text = f"{self.url}: nobody listens there ({error.strerror or error})"
            raise SilentServerError(f"{text}; start the policy's server") from None
        except TimeoutError:
            raise self._silent("the server does not accept the connection") from None
        except InvalidStatus as error:
            code = error.response.status_code
            raise PolicyServerError(f"{self.url}: {_explain_status(code)}") from None
        except (OSError, EOFError, InvalidHandshake, InvalidURI) as error:
            text = describe_error(error).partition(": ")[2] or describe_error(error)
            raise PolicyServerError(f"{self.url}: no connection: {text}") from None

    def _receive(self, what: str) -> dict[Any, Any]:
        assert self._connection is not None
        try:
            frame = self._connection.recv(timeout=self._limit)
        except TimeoutError:
            self.close()
            raise self._silent(f"no {what}") from None
        except ConnectionClosed as error:
            self.close()
            why = to_one_line(str(error))
            text = f"the server closed the connection before its {what} ({why})"
            raise SilentServerError(f"{self.url}: {text}") from None
        if isinstance(frame, str):
            self._fail_with(frame)
        try:
            return unpack(frame)
        except WireError as error:
            self.close()
            raise PolicyServerError(f"{self.url}: the {what} cannot be read: {error}") from None

    def _fail_with(self, text: str) -> NoReturn:
        self.close()
        last = to_one_line(text.strip()[-2000:].rpartition("\n")[2]) or "an empty text"
        raise PolicyServerError(f"{self.url}: the server sent an error: {last}")

    def _silent(self, text: str) -> SilentServerError:
        return SilentServerError(f"{self.url}: {text} within {self._limit:g} s")


def _explain_status(code: int) -> str:
    if code in (401, 403):
        return f"the server denies the API key ({code}); set {KEY_VARIABLE}"
    return f"the server answers with HTTP status {code}; is it a policy's server?"
