# SPDX-License-Identifier: Apache-2.0

"""Answer `PUT /link` on a Unix socket, and send it to one: how a running link is changed."""

from __future__ import annotations

import os
import socket
import socketserver
import time
from collections.abc import Callable
from pathlib import Path

from cloudrc.base.errors import CloudrcError
from cloudrc.flight.pod.http import HttpHandler
from cloudrc.flight.pod.servers import ThreadedServer
from cloudrc.link.control import APPLY_LIMIT, OK, REFUSED, read_answer
from cloudrc.link.state import LinkState, to_text

ANSWER_MAX = 16 << 20
"""Largest size of an answer [bytes]."""
LOOK_PERIOD = 0.01
"""Time between two looks whether a direction has decided about a change [s]."""

Change = Callable[[bytes], str]
"""Function that takes the body of a request as the new profile; returns the number of the change.
Raises a CloudrcError or a ValueError if the body is no valid change."""
State = Callable[[], LinkState | None]
"""Function that returns the present state of the direction."""


class ControlServer(ThreadedServer, socketserver.UnixStreamServer):
    """Answers on a socket that only the user of this process can open."""

    def __init__(self, path: Path, change: Change, state: State) -> None:
        """Serve at `path`, on threads of its own."""
        self.change, self.state = change, state
        path.unlink(missing_ok=True)  # of an earlier process
        super().__init__(str(path), _Handler)
        self.start()

    def server_bind(self) -> None:
        """Bind the socket; it has its rights before it listens."""
        super().server_bind()
        os.chmod(str(self.server_address), 0o600)


class _Handler(HttpHandler):
    server: ControlServer
    timeout = APPLY_LIMIT

    def do_PUT(self) -> None:  # noqa: N802
        size = int(self.headers.get("Content-Length") or 0)
        try:
            number = self.server.change(self.rfile.read(size))
        except (CloudrcError, ValueError, OSError) as error:
            self.answer(REFUSED, str(error))
            return
        until = time.monotonic() + APPLY_LIMIT
        while (state := self.server.state()) is None or not state.has_decided(number):
            if time.monotonic() > until:
                break
            time.sleep(LOOK_PERIOD)
        if state is None:
            self.answer(REFUSED, "the link waits for the address of its peer")
        else:
            self.answer(OK, to_text(state), "application/json")


def ask(path: Path, request: bytes) -> LinkState:
    """Send a request to the socket of a direction; return the state of the direction.

    Raise an OSError if nothing listens there, a ValueError or a CloudrcError as `read_answer`.
    """
    with socket.socket(socket.AF_UNIX) as connection:
        connection.settimeout(2 * APPLY_LIMIT)
        connection.connect(str(path))
        connection.sendall(request)
        answer = b""
        while len(answer) < ANSWER_MAX and (data := connection.recv(1 << 16)):
            answer += data
    return read_answer(answer)
