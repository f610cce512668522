"""The API's server: an ASGI application on a thread of its own, beside teleop's loop."""

from __future__ import annotations

import socket
import threading
from typing import Any

import uvicorn

from cloudrc.cloud.teleop.api_bridge import Bridge
from cloudrc.errors import BadInputError

STOP_LIMIT = 1.0
"""For requests to end once the server shall stop [s]."""
CONNECTIONS_MAX = 128


class ApiServer:
    """Serves from `start` to `stop`.

    Attributes:
        url: Where.
    """

    def __init__(self, app: Any, bridge: Bridge, address: tuple[str, int]) -> None:
        """Bind; port 0 lets the kernel choose.

        Raises:
            BadInputError: If the address cannot be had.
        """
        host, port = address
        family = socket.AF_INET6 if ":" in host else socket.AF_INET
        self._socket = socket.socket(family, socket.SOCK_STREAM)
        self._socket.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            self._socket.bind((host.strip("[]"), port))
        except OSError as error:
            self._socket.close()
            text = f"--api {host}:{port}: {error.strerror or error}; choose another address"
            raise BadInputError(text) from error
        self.url = f"http://{host}:{self._socket.getsockname()[1]}"
        self._bridge = bridge
        self._server = uvicorn.Server(
            uvicorn.Config(
                app,
                loop="asyncio",
                http="h11",
                ws="none",
                lifespan="off",
                log_level="error",  # a flood is refused without a line for each
                access_log=False,
                server_header=False,
                limit_concurrency=CONNECTIONS_MAX,
                timeout_graceful_shutdown=1,
            )
        )
        # A daemon, so that a client that hangs cannot keep the process from ending.
        self._thread = threading.Thread(target=self._run, name="api", daemon=True)

    def start(self) -> None:
        """Begin to serve; who asks from now on is answered, if a little later."""
        self._socket.listen(CONNECTIONS_MAX)
        self._thread.start()

    def stop(self) -> None:
        """Answer what is asked, end the streams, and end."""
        self._bridge.closed = "teleop ends"
        self._server.should_exit = True
        self._thread.join(STOP_LIMIT)
        self._socket.close()

    def _run(self) -> None:
        self._server.run(sockets=[self._socket])
