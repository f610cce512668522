"""The route file: one line HOST:PORT that says where this pod's end of the tunnel has to send.

The link's process writes it once the way is open, and again when the peer moves; the loop looks at
it twice a second. A look costs a system call, so the host is a number: a name would have to be
asked for, and the loop would wait for the answer.
"""

from __future__ import annotations

from ipaddress import AddressValueError, IPv4Address
from pathlib import Path

from cloudrc.files import read, version

Address = tuple[str, int]


class Route:
    """Follows the file; what cannot be read changes nothing."""

    def __init__(self, path: Path) -> None:
        """Follow the file at `path`, which need not be there yet."""
        self._path = path
        self._seen: tuple[int, int, int] | None = None
        self._address: Address | None = None

    def look(self) -> Address | None:
        """Where to send; None before the file has been there.

        A file that is gone, or half written, leaves the last address in place.
        """
        try:
            seen = version(self._path)
            if seen != self._seen:
                self._address = parse(read(self._path).decode("ascii"))
                self._seen = seen
        except (OSError, ValueError):
            self._seen = None
        return self._address


def parse(text: str) -> Address:
    """Read HOST:PORT.

    Raises:
        ValueError: If it is not an IPv4 address in numbers and a port.
    """
    host, _, port = text.strip().rpartition(":")
    try:
        numeric = str(IPv4Address(host))
    except AddressValueError as error:
        raise ValueError(f"'{host}' is not an address in numbers") from error
    if not port.isdecimal() or not 0 < int(port) < 65_536:
        raise ValueError(f"'{port}' is not a port")
    return numeric, int(port)
