"""Send datagrams that may be lost."""

from __future__ import annotations

import socket
from contextlib import suppress


def send_or_lose(one: socket.socket, data: bytes, to: tuple[str, int] | str) -> None:
    """Send a datagram; it is lost if nobody receives it, or if the kernel does not take it."""
    with suppress(OSError):
        one.sendto(data, to)
