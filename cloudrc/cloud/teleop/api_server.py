"""The API's server: an ASGI application on a thread of its own, beside teleop's loop."""

from __future__ import annotations

import os
import socket
import threading
from collections import Counter
from pathlib import Path
from typing import TypeAlias

import uvicorn

from cloudrc.cloud.teleop.api_bridge import Bridge
from cloudrc.cloud.teleop.api_connections import HEAD_LIMIT, Crowd
from cloudrc.cloud.teleop.api_gate import Gate
from cloudrc.errors import BadInputError

Address: TypeAlias = tuple[str, int] | Path
"""Host and port, or the path of a Unix socket."""
STOP_LIMIT = 1.0
"""For requests to end once the server shall stop [s]."""
BACKLOG = 1_024
"""Connections that the kernel keeps until they are taken."""
ACCEPT_MAX = 16
"""Connections taken before those that are there are read: of more, the emergency stop's could be
the longest without a request, and be cut off, though it is there."""
HEAD_MAX = 4_096
"""Length of a request's head [bytes]; one of shortest lines is 4 ms of work."""


class ApiServer:
    """Serves from `start` to `stop`.

    Attributes:
        url: Where; "unix:PATH" for a Unix socket.
    """

    def __init__(self, gate: Gate, bridge: Bridge, address: Address) -> None:
        """Bind; port 0 lets the kernel choose.

        Args:
            gate: Before the application.
            bridge: To teleop's loop.
            address: A Unix socket's file is for its owner alone.

        Raises:
            BadInputError: If the address cannot be had, or anybody there could command.
        """
        if gate.open and not isinstance(address, Path):
            raise BadInputError(
                "--api HOST:PORT needs --tokens DIR, with a file 'operator' in it; "
                "without tokens only a socket file is served: --api unix:PATH"
            )
        self._crowd, self._gate, self._bridge = Crowd(), gate, bridge
        self._socket, self.url = _bound(address)
        self._server = _Server(
            uvicorn.Config(
                gate,
                loop="asyncio",
                http=self._crowd.protocol(),
                ws="none",
                lifespan="off",
                log_level="critical",  # a flood is refused without a line for each
                access_log=False,
                server_header=False,
                proxy_headers=False,  # the audit log names whoever connects, not whom they name
                backlog=ACCEPT_MAX,
                h11_max_incomplete_event_size=HEAD_MAX,
                timeout_keep_alive=round(HEAD_LIMIT),
                timeout_graceful_shutdown=1,
            )
        )
        # A daemon, so that a client that hangs cannot keep the process from ending.
        self._thread = threading.Thread(target=self._run, name="api", daemon=True)

    @property
    def counts(self) -> Counter[str]:
        """What was done with requests and connections, by reason."""
        return self._gate.counts + self._crowd.counts

    def start(self) -> None:
        """Begin to serve; who asks from now on is answered, if a little later."""
        self._socket.listen(BACKLOG)
        self._thread.start()

    def stop(self) -> None:
        """Answer what is asked, end the streams, and end."""
        self._bridge.closed = "teleop ends"
        self._server.should_exit = True
        self._thread.join(STOP_LIMIT)
        self._socket.close()

    def _run(self) -> None:
        self._server.run(sockets=[self._socket])


class _Server(uvicorn.Server):
    """Takes few connections at a time, and lets many wait; for asyncio both is one number."""

    async def startup(self, sockets: list[socket.socket] | None = None) -> None:
        """Begin to serve."""
        await super().startup(sockets)
        for each in sockets or []:
            each.listen(BACKLOG)


def _bound(address: Address) -> tuple[socket.socket, str]:
    """A socket bound at an address, and its URL."""
    if isinstance(address, Path):
        return _bound_file(address), f"unix:{address}"
    host, port = address
    family = socket.AF_INET6 if ":" in host else socket.AF_INET
    tcp = socket.socket(family, socket.SOCK_STREAM)
    tcp.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
    try:
        tcp.bind((host.strip("[]"), port))
    except OSError as error:
        tcp.close()
        text = f"--api {host}:{port}: {error.strerror or error}; choose another address"
        raise BadInputError(text) from error
    return tcp, f"http://{host}:{tcp.getsockname()[1]}"


def _bound_file(path: Path) -> socket.socket:
    """A Unix socket that its owner alone can connect to, from its first instant."""
    unix = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
    os.fchmod(unix.fileno(), 0o600)  # Linux gives the file the mode of the socket
    try:
        if path.is_socket():  # of a server before this one
            path.unlink()
        unix.bind(str(path))
    except OSError as error:
        unix.close()
        raise BadInputError(
            f"--api unix:{path}: {error.strerror or error}; choose another path"
        ) from error
    return unix
