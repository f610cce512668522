# SPDX-License-Identifier: Apache-2.0

"""Send datagrams that may be lost, and receive what has arrived."""

from __future__ import annotations

import socket
from collections.abc import Iterator
from contextlib import suppress


def send_or_lose(one: socket.socket, data: bytes, to: tuple[str, int] | str) -> None:
    """Send a datagram; it is lost if nobody receives it, or if the kernel does not take it."""
    with suppress(OSError):
        one.sendto(data, to)


def receive_all(one: socket.socket, size_max: int) -> Iterator[bytes]:
    """Yield the datagrams that have arrived, each of at most `size_max` bytes."""
    while True:
        try:
            yield one.recv(size_max)
        except BlockingIOError:
            return
        except ConnectionError:  # nobody received a datagram that we sent before
            continue
