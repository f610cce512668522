# SPDX-License-Identifier: Apache-2.0

"""Serve requests on threads: what the small servers of a process have in common."""

from __future__ import annotations

import socketserver
import threading
from typing import Any

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
