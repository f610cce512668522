# SPDX-License-Identifier: Apache-2.0

"""Read the kernel's tables about the network namespace of this process."""

from __future__ import annotations

import socket
import sys
from pathlib import Path

_LISTEN, _UNCONNECTED = 0x0A, 0x07  # states of TCP and UDP sockets
TABLES = {"tcp": _LISTEN, "tcp6": _LISTEN, "udp": _UNCONNECTED, "udp6": _UNCONNECTED}


def listening_at() -> list[tuple[str, int]]:
    """Return host and port of each socket that listens in the namespace of this process.

    Source: Linux, Documentation/networking/proc_net_tcp.rst.
    """
    found = []
    for table, listens in TABLES.items():
        try:
            lines = Path(f"/proc/self/net/{table}").read_text(encoding="ascii").splitlines()
        except OSError:  # IPv6 is off
            continue
        for line in lines[1:]:
            _, local, _, state, *_ = line.split()
            if int(state, 16) == listens:
                host, _, port = local.partition(":")
                found.append((_address(host), int(port, 16)))
    return found


def dropped_packets(device: str) -> int:
    """Return how many packets a device has dropped because nobody read them in time.

    Source: Linux, net/core/net-procfs.c: the fourth count of the sending side.
    """
    for line in Path("/proc/self/net/dev").read_text(encoding="ascii").splitlines():
        name, _, counts = line.partition(":")
        if name.strip() == device:
            return int(counts.split()[11])
    return 0


def is_loopback(host: str) -> bool:
    """Return whether only programs in the same namespace reach the host."""
    return host.startswith("127.") or host == "::1"


def _address(words: str) -> str:
    """Convert an address of the kernel's table: 32-bit words in the machine's byte order."""
    parts = [int(words[at : at + 8], 16) for at in range(0, len(words), 8)]
    data = b"".join(part.to_bytes(4, sys.byteorder) for part in parts)
    return socket.inet_ntop(socket.AF_INET if len(data) == 4 else socket.AF_INET6, data)
