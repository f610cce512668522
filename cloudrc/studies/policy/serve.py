# SPDX-License-Identifier: Apache-2.0

"""Serve a policy of the user over a WebSocket."""

from __future__ import annotations

import asyncio
import hmac
import logging
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from contextlib import AbstractAsyncContextManager, nullcontext
from http import HTTPStatus
from typing import Any

from websockets.asyncio.server import Server, ServerConnection, serve
from websockets.exceptions import ConnectionClosed
from websockets.http11 import Request, Response

from cloudrc.base.errors import describe_error
from cloudrc.base.files import at_place
from cloudrc.flight.pod.openpi.actions import PolicyAnswerError, read_actions
from cloudrc.flight.pod.openpi.codec import MESSAGE_MAX, WireError, pack, unpack
from cloudrc.studies.policy.load import LoadedPolicy, PolicyFailedError

HEALTH = "/healthz"
FAILED = 1011
"""Code with which a server closes a connection after an error. Source: RFC 6455, 7.4.1."""
CLOSE_LIMIT = 1.0
"""Time for which a server waits for a client's end of a connection [s]."""
_quiet = logging.Logger("cloudrc.studies.policy")
"""Log of the library, which writes the stack of every connection that fails."""
_quiet.addHandler(logging.NullHandler())


class PolicyServer:
    """Serves one policy; its functions run one at a time, in one thread.

    A policy with `reset` serves one connection at a time, and is reset at its beginning: a
    connection is an episode. Another client waits for the metadata meanwhile.
    """

    def __init__(self, name: str, tell: Callable[[str], None], key: str = "") -> None:
        """Serve the policy of the file `name`; `tell` gets lines for the log.

        With `key`, clients must send this API key.
        """
        self._name, self._tell, self._key = name, tell, key
        # Libraries such as those of GPUs and OpenGL want one thread from the import on.
        self._thread = ThreadPoolExecutor(1, "policy")
        self._episode: AbstractAsyncContextManager[Any] = nullcontext()

    async def run(self, host: str, port: int, ready: Callable[[int], None]) -> None:
        """Serve until this task is cancelled; port 0: any free one. `ready` gets the port."""
        try:
            self._policy = await self._call(LoadedPolicy, self._name)
            if self._policy.has_state:
                self._episode = asyncio.Lock()
            async with await self._open(host, port) as server:
                ready(next(iter(server.sockets)).getsockname()[1])
                await server.serve_forever()
        finally:
            self._thread.shutdown(wait=False, cancel_futures=True)

    async def _open(self, host: str, port: int) -> Server:
        with at_place(f"{host}, port {port}"):
            return await serve(
                self._handle,
                host,
                port,
                compression=None,
                max_size=MESSAGE_MAX,
                close_timeout=CLOSE_LIMIT,
                origins=[None],  # a page in a browser sends one: it may not reach the policy
                process_request=self._check_request,
                logger=_quiet,
            )

    async def _call(self, function: Callable[..., Any], *arguments: Any) -> Any:
        """Call a function of the policy in its thread."""
        return await asyncio.get_running_loop().run_in_executor(self._thread, function, *arguments)

    def _check_request(self, connection: ServerConnection, request: Request) -> Response | None:
        if request.path == HEALTH:
            return connection.respond(HTTPStatus.OK, "OK\n")
        given = request.headers.get("Authorization", "")
        if self._key and not hmac.compare_digest(given.encode(), f"Api-Key {self._key}".encode()):
            return connection.respond(HTTPStatus.UNAUTHORIZED, "a valid API key is missing\n")
        return None

    async def _handle(self, connection: ServerConnection) -> None:
        host, port = connection.remote_address[:2]
        client = f"client {host}:{port}"
        try:
            async with self._episode:
                await self._serve_episode(connection)
            self._tell(f"{client} has left")
        except ConnectionClosed:
            self._tell(f"{client} is gone")
        except (PolicyFailedError, PolicyAnswerError, WireError) as error:
            self._tell(f"{client}: {error}")
            stack = getattr(error, "stack", "") or describe_error(error)
            try:
                await connection.send(stack)
                await connection.close(FAILED, "the policy failed")
            except ConnectionClosed:
                pass

    async def _serve_episode(self, connection: ServerConnection) -> None:
        policy = self._policy
        await self._call(policy.reset)
        await connection.send(pack(policy.metadata))
        total: float | None = None
        async for frame in connection:
            start = time.perf_counter()
            if isinstance(frame, str):
                raise WireError("a text in place of a binary frame with an observation")
            observation = unpack(frame)
            inferring = time.perf_counter()
            answer = await self._call(policy.infer, observation)
            infer_ms = 1e3 * (time.perf_counter() - inferring)
            if answer is None:  # nothing new to send
                answer, actions = {}, None
            else:
                actions = read_actions(answer, may_switch=True)  # the client knows its robot
            timing = {"infer_ms": infer_ms}
            if total is not None:
                timing["prev_total_ms"] = 1e3 * total
            await connection.send(pack({**answer, "actions": actions, "server_timing": timing}))
            total = time.perf_counter() - start
