# SPDX-License-Identifier: Apache-2.0

"""Serve requests on threads: what the small servers of a process have in common."""

from __future__ import annotations

import socketserver
import threading
from http.server import BaseHTTPRequestHandler
from typing import Any

TEXT = "text/plain; charset=utf-8"
"""Content type of a text."""
LOOK_PERIOD = 0.1
"""Time between two looks whether the server has to end [s]."""


class ThreadedServer(socketserver.ThreadingMixIn, socketserver.BaseServer):
    """Answers each request on a thread of its own, and ends with the process."""

    allow_reuse_address = True
    daemon_threads = True
    block_on_close = False

    def start(self) -> None:
        """Answer requests from now on."""
        work = threading.Thread(target=self.serve_forever, args=(LOOK_PERIOD,), daemon=True)
        work.start()

    def close(self) -> None:
        """Answer no more requests; this takes up to `LOOK_PERIOD`."""
        self.shutdown()
        self.server_close()

    def handle_error(self, request: Any, client_address: Any) -> None:
        """Ignore the errors of clients that disconnect early."""


class HttpHandler(BaseHTTPRequestHandler):
    """Answers one HTTP request and closes the connection."""

    def answer(self, status: int, text: str, kind: str = TEXT) -> None:
        """Send an answer; `kind` is its content type."""
        content = text.encode()
        self.send_response(status)
        self.send_header("Content-Type", kind)
        self.send_header("Content-Length", str(len(content)))
        self.end_headers()
        self.wfile.write(content)

    def log_message(self, format: str, *args: Any) -> None:
        """Log nothing, because requests arrive every few seconds."""
