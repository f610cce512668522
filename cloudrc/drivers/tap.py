"""Send cloud's newest records to a console through a Unix socket, and receive them there.

A datagram contains the newest record of each type that a console shows, one per line as made by
`to_line`. Cloud never waits: a datagram is lost if no listener runs or the listener is too slow.
"""

from __future__ import annotations

import os
import socket
import time
from collections.abc import Callable, Iterable
from contextlib import suppress
from pathlib import Path

from cloudrc.drivers.process import from_line, to_line
from cloudrc.errors import BadInputError
from cloudrc.messages import Telemetry
from cloudrc.records import Arrival, Control, Record, SessionOpened, TelemetrySent

TAP_FILE = "tap.sock"
"""Name of the tap's socket, in the folder of the API's socket."""
PERIOD = 0.03
"""Average time between two datagrams [s]."""
ALONE_PERIOD = 0.5
"""Time between two attempts to send while no listener runs [s]."""
DATAGRAM_MAX = 1 << 16
"""Size limit of a datagram [bytes]."""


class Tap:
    """Sends cloud's newest records to a Unix socket, without blocking."""

    def __init__(self, path: Path, telemetry: Callable[[], Telemetry | None]) -> None:
        """Prepare to send to the socket at `path`, which may appear later.

        `telemetry` returns the newest telemetry that cloud has received; None before the first.
        Cloud does not record received telemetry. Therefore the tap sends it as world's record,
        `TelemetrySent`, with epoch and counter 0.
        """
        self._path, self._telemetry = os.fspath(path), telemetry
        self._socket = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
        self._socket.setblocking(False)
        # Newest records that have not been sent: session, used arrival, and control period.
        self._session: list[Record] = []
        self._arrival: Record | None = None
        self._period: list[Record] = []  # begins with the newest arrival before the period
        self._due = 0.0

    def tell(self, records: Iterable[Record]) -> None:
        """Store new `records`, oldest first; send the newest if the next datagram is due."""
        for record in records:
            if isinstance(record, Arrival):
                self._arrival = record if record.used else self._arrival
            elif isinstance(record, Control):
                self._period = [self._arrival, record] if self._arrival else [record]
            elif isinstance(record, SessionOpened):
                self._session = [record]
        now = time.monotonic()
        if now < self._due:
            return
        self._due = max(self._due, now - PERIOD) + PERIOD
        try:
            self._socket.sendto(self._datagram(), self._path)
        except BlockingIOError:  # the listener does not keep up
            pass
        except OSError:  # nobody listens
            self._due = now + ALONE_PERIOD
        self._arrival, self._session, self._period = None, [], []

    def _datagram(self) -> bytes:
        newest = [*self._session, *(self._period or filter(None, [self._arrival]))]
        if (telemetry := self._telemetry()) is not None:
            newest.append(TelemetrySent(telemetry.stamp_ns, 0, 0, telemetry))
        return "\n".join(map(to_line, newest)).encode(errors="backslashreplace")


class TapListener:
    """Receives the datagrams of one `Tap`, which sends to at most one listener."""

    def __init__(self, path: Path) -> None:
        """Become the listener of the tap that sends to the socket `path`.

        Raises:
            BadInputError: If another process listens at `path`.
        """
        self._path = path
        self._socket = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
        try:
            self._socket.connect(os.fspath(path))
        except OSError:  # nobody listens; a killed listener leaves its file
            path.unlink(missing_ok=True)
        else:
            self._socket.close()
            raise BadInputError("this run has a console already; open its page, or end it first")
        self._socket.bind(os.fspath(path))

    def receive(self, limit: float) -> list[Record]:
        """Wait at most `limit` [s] for a datagram; return the records of all that have arrived."""
        found: list[Record] = []
        self._socket.settimeout(limit)
        with suppress(OSError):  # nothing (more) has arrived
            while True:
                for line in self._socket.recv(DATAGRAM_MAX).decode().splitlines():
                    with suppress(ValueError):
                        found.append(from_line(line))
                self._socket.setblocking(False)
        return found

    def close(self) -> None:
        """Close the socket and remove its file."""
        self._socket.close()
        self._path.unlink(missing_ok=True)
