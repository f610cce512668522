"""A relay as one would write it with asyncio: `call_later`, whose clock epoll rounds up to 1 ms.

usage: asyncio_relay.py LISTEN_PORT TARGET_PORT DELAY
"""

from __future__ import annotations

import asyncio
import sys
from typing import Any


class Relay(asyncio.DatagramProtocol):
    """Sends on what it gets, later."""

    def __init__(self, target: tuple[str, int], delay: float) -> None:
        """Delay everything by `delay` [s]."""
        self._target, self._delay = target, delay

    def connection_made(self, transport: Any) -> None:
        """Keep the transport."""
        self._transport = transport
        self._loop = asyncio.get_running_loop()

    def datagram_received(self, data: bytes, addr: tuple[str | Any, int]) -> None:
        """Send it on when it is due."""
        self._loop.call_later(self._delay, self._transport.sendto, data, self._target)


async def main() -> None:
    """Relay until killed."""
    listen, target, delay = int(sys.argv[1]), int(sys.argv[2]), float(sys.argv[3])
    await asyncio.get_running_loop().create_datagram_endpoint(
        lambda: Relay(("127.0.0.1", target), delay), local_addr=("127.0.0.1", listen)
    )
    print("ready", flush=True)
    await asyncio.Event().wait()


if __name__ == "__main__":
    asyncio.run(main())
