"""The small HTTP server of every process: metrics and probes, answered on threads of their own.

No client can do harm: a connection lives 5 s at most, whatever it sends or does not read, and when
too many are open the oldest gives way, so that a probe always gets its answer.
"""

from __future__ import annotations

import contextlib
import errno
import socket
import socketserver
import threading
import time
from collections.abc import Callable, Mapping
from http.server import BaseHTTPRequestHandler
from typing import Any, NamedTuple

from cloudrc.errors import MissingPrerequisiteError

CONNECTIONS_MAX = 16
LIFETIME = 5.0
"""Of one connection [s]; the scrape timeout of Prometheus is 10 s by default."""
LOOK_PERIOD = 0.25
"""How often it is looked for connections that have lived too long [s]."""
PLAIN = "text/plain; charset=utf-8"


class Answer(NamedTuple):
    """What a path answers: HTTP status, content and its type."""

    status: int
    content: bytes
    kind: str = PLAIN


Pages = Mapping[str, Callable[[], Answer]]


class ProbeServer(socketserver.ThreadingTCPServer):
    """Serves pages until it is closed.

    Not `http.server.HTTPServer`, which asks the name service for its own name, and may wait for it.
    A flood of connections fills the queue of those that wait to be taken, and behind a full one the
    kernel drops kubelet's, too: tried again after 1 s, perhaps in vain, its probe fails after 2 or
    5 s, though nothing is wrong. So the queue is as long as that of the API.
    """

    allow_reuse_address = True
    daemon_threads = True
    block_on_close = False
    request_queue_size = 1_024

    def __init__(self, address: tuple[str, int], pages: Pages) -> None:
        """Bind and begin to answer.

        Args:
            address: Host and port; port 0 lets the kernel choose.
            pages: By path.

        Raises:
            MissingPrerequisiteError: If the address cannot be had.
        """
        self.pages = pages
        self._open: dict[Any, float] = {}
        self._guard = threading.Lock()
        try:
            super().__init__(address, _Handler)
        except OSError as error:
            raise MissingPrerequisiteError(_explain(address, error)) from error
        self._thread = threading.Thread(
            target=self.serve_forever, args=(LOOK_PERIOD,), name="metrics", daemon=True
        )
        self._thread.start()

    def close(self) -> None:
        """Stop answering; takes a quarter of a second."""
        self.shutdown()
        self.server_close()
        self._thread.join(1.0)

    def process_request(self, request: Any, client_address: Any) -> None:
        """Answer on a thread; the oldest connection gives way if there are too many."""
        with self._guard:
            if len(self._open) >= CONNECTIONS_MAX:
                oldest = min(self._open, key=self._open.__getitem__)
                del self._open[oldest]
                _cut(oldest)
            self._open[request] = time.monotonic()
        super().process_request(request, client_address)

    def shutdown_request(self, request: Any) -> None:
        """Forget and close a connection, however it ended."""
        with self._guard:
            self._open.pop(request, None)
        super().shutdown_request(request)

    def service_actions(self) -> None:
        """Now and then: cut the connections that have lived long enough."""
        until = time.monotonic() - LIFETIME
        with self._guard:
            for request, since in self._open.items():
                if since < until:
                    _cut(request)

    def handle_error(self, request: Any, client_address: Any) -> None:
        """A client that leaves early is no news."""


class _Handler(BaseHTTPRequestHandler):
    """Answers one request and closes the connection."""

    server: ProbeServer
    timeout = LIFETIME

    def do_GET(self) -> None:
        """Answer with the page, if there is one."""
        page = self.server.pages.get(self.path.partition("?")[0])
        paths = ", ".join(self.server.pages)
        answer = page() if page else Answer(404, f"there are {paths}\n".encode())
        self.send_response(answer.status)
        self.send_header("Content-Type", answer.kind)
        self.send_header("Content-Length", str(len(answer.content)))
        self.end_headers()
        self.wfile.write(answer.content)

    def log_message(self, format: str, *args: Any) -> None:
        """Requests are not logged: there is one every few seconds."""


def _cut(request: socket.socket) -> None:
    """End a connection under the thread that serves it, which then notices."""
    with contextlib.suppress(OSError):
        request.shutdown(socket.SHUT_RDWR)


def _explain(address: tuple[str, int], error: OSError) -> str:
    host, port = address
    if error.errno == errno.EADDRINUSE:
        return (
            f"metrics port {port} is taken: another process listens on {host}:{port};"
            " end it or choose another port with --metrics"
        )
    return f"metrics cannot be served on {host}:{port}: {error.strerror or error}; see --metrics"
