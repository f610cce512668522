"""The contract of both ends: a state machine that bytes and instants go into and come out of.

An endpoint owns no socket, no clock and no thread. A driver calls it, and is the only one that
knows whether time is virtual or real:

    for data in arrived:
        endpoint.receive_datagram(data, now_ns)
    if now_ns >= endpoint.next_deadline_ns():
        endpoint.handle_deadline(now_ns)
    send(endpoint.take_datagrams())
    keep(endpoint.take_records())

Rules for drivers: `now_ns` never falls. All datagrams that are drained in one wake carry the same
`now_ns`, which lets an endpoint tell what waited in the socket while its process stood still.
"""

from __future__ import annotations

from typing import Protocol

from cloudrc.records import Record


class Endpoint(Protocol):
    """One end of the tunnel, sans I/O. Times are integer nanoseconds of its own clock."""

    @property
    def sealed(self) -> bool:
        """Whether its datagrams are sealed; one whose are not must not come near a socket."""

    def receive_datagram(self, data: bytes, now_ns: int) -> None:
        """Take in one datagram; one that is not valid is counted and dropped, never raised."""

    def next_deadline_ns(self) -> int:
        """Say when `handle_deadline` wants to be called next [ns]."""

    def handle_deadline(self, now_ns: int) -> None:
        """Do what is due at `now_ns` [ns]; being late is allowed and does no harm."""

    def take_datagrams(self) -> list[bytes]:
        """Hand over the datagrams to send, oldest first; they are then forgotten."""

    def take_records(self) -> list[Record]:
        """Hand over the records since the last call, oldest first; they are then forgotten."""
