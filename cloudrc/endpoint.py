"""The contract of both ends of the tunnel: state machines without I/O.

An endpoint has no socket, no clock and no thread. A driver calls the endpoint, and only the driver
knows whether time is virtual or real:

    for data in arrived:
        endpoint.receive_datagram(data, now_ns)
    if now_ns >= endpoint.next_deadline_ns():
        endpoint.handle_deadline(now_ns)
    send(endpoint.take_datagrams())
    keep(endpoint.take_records())

`now_ns` never falls. All datagrams that a driver reads in one wake get the same `now_ns`: so an
endpoint knows what waited in the socket while its process was stalled.
"""

from __future__ import annotations

from typing import Protocol

from cloudrc.records import Record


class Endpoint(Protocol):
    """One end of the tunnel. All times are integer nanoseconds on the clock of this end."""

    @property
    def sealed(self) -> bool:
        """Whether the endpoint's datagrams are authenticated; only these may reach a socket."""

    def receive_datagram(self, data: bytes, now_ns: int) -> None:
        """Handle one datagram. Count and drop an invalid datagram, without an exception."""

    def next_deadline_ns(self) -> int:
        """Return the time of the next call of `handle_deadline` [ns]."""

    def handle_deadline(self, now_ns: int) -> None:
        """Do the work that is due at `now_ns` [ns]; the call may be late."""

    def take_datagrams(self) -> list[bytes]:
        """Return the datagrams to send, made since the last call, oldest first."""

    def take_records(self) -> list[Record]:
        """Return the records made since the last call, oldest first."""
