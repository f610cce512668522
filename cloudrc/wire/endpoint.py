# SPDX-License-Identifier: Apache-2.0

"""Define the interface of world and cloud to their driver: state machines without I/O.

World and cloud are endpoints, the two ends of the tunnel. An endpoint has no socket, no clock and
no thread. A driver calls its methods, and only the driver knows whether time is virtual or real:

    for data in arrived:
        endpoint.receive_datagram(data, now_ns)
    if now_ns >= endpoint.next_deadline_ns():
        endpoint.handle_deadline(now_ns)
    send(endpoint.take_datagrams())
    keep(endpoint.take_records())

`now_ns` never decreases. All datagrams that a driver reads at once get the same `now_ns`. So an
endpoint can detect datagrams that waited in the socket while its process was stalled.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple, Protocol

from cloudrc.wire.messages import Datagram
from cloudrc.wire.records import Record


class Endpoint(Protocol):
    """World or cloud, as its driver sees it. All times are integer nanoseconds on its own clock."""

    def receive_datagram(self, data: Datagram, now_ns: int) -> None:
        """Process one datagram; count and drop an invalid datagram, without an exception."""

    def next_deadline_ns(self) -> int:
        """Return the time at which `handle_deadline` must be called next [ns]."""

    def handle_deadline(self, now_ns: int) -> None:
        """Do the work that is due at `now_ns` [ns]; the driver may call this late."""

    def take_datagrams(self) -> list[Datagram]:
        """Return the datagrams to send, oldest first; the next call returns only newer ones."""

    def take_records(self) -> list[Record]:
        """Return the records, oldest first; the next call returns only newer ones."""


class Outcome(NamedTuple):
    """What a call of a user's code returned or raised; times are on the end's clock."""

    result: Any
    error: BaseException | None
    begun_ns: int
    done_ns: int


class Worker(Protocol):
    """Makes calls that may take long, one at a time, beside an endpoint: here or in a thread."""

    def begin(self, call: Callable[[], Any], now_ns: int) -> None:
        """Begin a call at `now_ns` [ns], the end's clock; the outcome of the last one is taken."""

    def take(self) -> Outcome | None:
        """Return the outcome of the call once, as soon as it is known."""
