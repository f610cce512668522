"""The contract of both ends of the tunnel: state machines without I/O.

An endpoint has no socket, no clock and no thread. A driver calls it; only the driver knows whether
time is virtual or real:

    for data in arrived:
        endpoint.receive_datagram(data, now_ns)
    if now_ns >= endpoint.next_deadline_ns():
        endpoint.handle_deadline(now_ns)
    send(endpoint.take_datagrams())
    keep(endpoint.take_records())

Rules for drivers: `now_ns` never falls. All datagrams that are read in one wake get the same
`now_ns`, so that an endpoint knows which ones waited in the socket while its process was stalled.
"""

from __future__ import annotations

from typing import Protocol

from cloudrc.records import Record


class Endpoint(Protocol):
    """One end of the tunnel. Times are integer nanoseconds on its own clock."""

    @property
    def sealed(self) -> bool:
        """Whether its datagrams are authenticated; if not, they must never reach a socket."""

    def receive_datagram(self, data: bytes, now_ns: int) -> None:
        """Handle one datagram; an invalid one is counted and dropped and raises nothing."""

    def next_deadline_ns(self) -> int:
        """Return when to call `handle_deadline` next [ns]."""

    def handle_deadline(self, now_ns: int) -> None:
        """Do what is due at `now_ns` [ns]; a late call is allowed."""

    def take_datagrams(self) -> list[bytes]:
        """Return the datagrams to send since the last call, oldest first."""

    def take_records(self) -> list[Record]:
        """Return the records since the last call, oldest first."""
