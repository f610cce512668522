"""Unix datagram sockets: two processes of one machine, one message each way at a time.

Nothing here blocks and nothing is certain: what the other's full or missing socket refuses is
lost, as on a network. Paths are looked up with every datagram, so either process may restart.
"""

from __future__ import annotations

import socket
from pathlib import Path

from cloudrc.errors import BadInputError

DATAGRAM_MAX = 8_192
"""Longer than any message of ours [bytes]."""
DRAIN_MAX = 1024
"""Datagrams taken per wake, so that a flood cannot keep a loop from its deadlines; more than wait
at once: systemd lets 513, so that nothing of a stall is left for the wake behind it."""
PATH_MAX = 107
"""Bytes of a socket's path, less its end. Source: unix(7), `sun_path`."""


class UnixPeer:
    """A Unix datagram socket of our own, and the path of the other's.

    Attributes:
        unsent: How many datagrams the other did not take.
    """

    def __init__(self, own: Path, other: Path) -> None:
        """Bind `own`, in the place of what an earlier process may have left there.

        Raises:
            BadInputError: If the path cannot be bound.
        """
        self._own, self._other = own, str(other)
        self.unsent = 0
        if len(bytes(own)) > PATH_MAX:
            raise BadInputError(f"--socket: {own} is longer than {PATH_MAX} bytes; choose another")
        self._socket = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
        self._socket.setblocking(False)
        try:
            own.parent.mkdir(parents=True, exist_ok=True)
            own.unlink(missing_ok=True)
            self._socket.bind(str(own))
        except OSError as error:
            self._socket.close()
            raise BadInputError(f"--socket: cannot make {own}: {error.strerror}") from error

    def receive(self) -> list[bytes]:
        """Everything that waits in the socket."""
        datagrams: list[bytes] = []
        while len(datagrams) < DRAIN_MAX:
            try:
                datagrams.append(self._socket.recv(DATAGRAM_MAX))
            except BlockingIOError:
                break
        return datagrams

    def send(self, data: bytes) -> bool:
        """Send, if the other takes it now; say whether it did."""
        try:
            self._socket.sendto(data, self._other)
        except OSError:  # not there, not yet there again, or its queue is full
            self.unsent += 1
            return False
        return True

    def close(self) -> None:
        """Close; the path stays, since a successor may have bound it by now."""
        self._socket.close()
