# SPDX-License-Identifier: Apache-2.0

"""Serve an application over HTTP in a thread: teleop's API, or the console's page."""

from __future__ import annotations

import socket
import threading
from typing import Any

import uvicorn

STOP_LIMIT = 1
"""Time limit for open requests to end when the server stops [s]."""


class ThreadServer(uvicorn.Server):
    """Serves in a separate thread, from `start` to `stop`."""

    def __init__(
        self,
        app: Any,
        opened: socket.socket,
        http: Any = "h11",
        ws: Any = "none",
        **settings: Any,
    ) -> None:
        """Serve the ASGI application `app` at the socket `opened`.

        `http` and `ws` are uvicorn's settings: protocols for requests and for WebSockets.
        """
        super().__init__(
            uvicorn.Config(
                app,
                http=http,
                ws=ws,
                interface="asgi3",
                lifespan="off",
                log_level="critical",  # a flood does not fill the log
                access_log=False,
                server_header=False,
                proxy_headers=False,  # a log has the true address
                # No limit_concurrency: it would keep an emergency stop out, too.
                timeout_graceful_shutdown=STOP_LIMIT,
                **settings,
            )
        )
        # The new socket names its protocol: only then does asyncio disable Nagle's algorithm.
        self._socket = socket.socket(fileno=opened.detach())
        # A daemon, so that a client that hangs cannot keep the process from ending.
        self._thread = threading.Thread(target=self.run, args=([self._socket],), daemon=True)

    def start(self) -> None:
        """Start to serve."""
        self._thread.start()

    def stop(self) -> None:
        """Answer the open requests, end the streams, and stop to serve."""
        self.should_exit = True
        if self._thread.is_alive():
            self._thread.join(STOP_LIMIT)
        self._socket.close()
