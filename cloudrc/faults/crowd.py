"""Several clouds at one place: what arrives is heard by all of them, each sends what it wants."""

from __future__ import annotations

from collections.abc import Sequence

from cloudrc.endpoint import Endpoint
from cloudrc.records import Record


class Crowd:
    """Endpoints that share a socket, each awake from its own instant on; an `Endpoint` itself.

    Attributes:
        members: Those that are there; the first one's story is what the recording tells.
        others: What the others have noted down, oldest first.
    """

    def __init__(self, members: Sequence[Endpoint]) -> None:
        self.members = members
        self.others: list[Record] = []

    @property
    def sealed(self) -> bool:
        """See `Endpoint`."""
        return all(member.sealed for member in self.members)

    def receive_datagram(self, data: bytes, now_ns: int) -> None:
        """See `Endpoint`."""
        for member in self.members:
            member.receive_datagram(data, now_ns)

    def next_deadline_ns(self) -> int:
        """See `Endpoint`."""
        return min(member.next_deadline_ns() for member in self.members)

    def handle_deadline(self, now_ns: int) -> None:
        """See `Endpoint`."""
        for member in self.members:
            if now_ns >= member.next_deadline_ns():
                member.handle_deadline(now_ns)

    def take_datagrams(self) -> list[bytes]:
        """See `Endpoint`."""
        return [data for member in self.members for data in member.take_datagrams()]

    def take_records(self) -> list[Record]:
        """See `Endpoint`; only those of the first."""
        first, *others = (member.take_records() for member in self.members)
        for records in others:
            self.others += records
        return first
