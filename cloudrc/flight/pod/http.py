# SPDX-License-Identifier: Apache-2.0

"""Answer HTTP requests: what the small HTTP servers of a process have in common."""

from __future__ import annotations

from http.server import BaseHTTPRequestHandler
from typing import Any

TEXT = "text/plain; charset=utf-8"
"""Content type of a text."""


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
