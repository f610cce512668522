# SPDX-License-Identifier: Apache-2.0

"""Keep the packets that are in flight on a link, in the order of their arrivals.

Runs in virtual time, the relay and the warnings before a flight use the same queue. It has no clock
and no socket.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from heapq import heappop, heappush
from typing import Any

from cloudrc.link.model import LinkDirection

NOTHING_NS = 1 << 63
"""Time of the next arrival if no packet is in flight: later than any clock shows [ns]."""


class PacketQueue:
    """The packets in flight in one or both directions of a link.

    All times are on one clock. Packets that arrive at the same time keep the order of sending.

    Attributes:
        next_ns: Time of the next arrival [ns]; `NOTHING_NS` if no packet is in flight.
        lost: Number of packets that the link has lost.
        overflow: Number of copies that were dropped because the queue was full.
        watch: Is told of each packet that leaves a cell before the link: whether it is of the
            uplink, its header (kind, epoch, counter), when it was sent and when it leaves [ns].
    """

    def __init__(self, capacity: int | None = None) -> None:
        """Create an empty queue for at most `capacity` copies of packets; None: without a limit."""
        self._capacity = capacity
        # Time of arrival [ns], a number that keeps the order of equal times, direction, data.
        self._packets: list[tuple[int, int, Any, Any]] = []
        self._sent = 0
        self.next_ns = NOTHING_NS
        self.lost = self.overflow = 0
        self.watch: Callable[[bool, tuple[int, int, int], int, int], None] | None = None

    def send(
        self,
        link: LinkDirection,
        header: tuple[int, int, int],
        size: int,
        data: Any,
        now_ns: int,
    ) -> None:
        """Send a packet over a direction of the link: no copy arrives if it is lost, or several.

        `header` is the packet's kind, epoch and counter, `size` the length of its UDP payload
        [bytes]. If the link damages packets, `data` must be bytes.
        """
        kind, epoch, counter = header
        arrivals = link.send(epoch, kind, counter, size, now_ns)
        if arrivals and link.corrupts:
            data = link.corrupted(epoch, kind, counter, data)
        if len(arrivals) == 1 and self._capacity is None:  # as `put` does, without its call
            self._sent += 1
            packets = self._packets
            heappush(packets, (arrivals[0], self._sent, link, data))
            self.next_ns = packets[0][0]
        else:
            self.put(link, arrivals, data)

    def put(self, link: Any, arrivals: Sequence[int], data: Any) -> None:
        """Take the copies of a packet that arrive at `arrivals` [ns]; without any, it is lost.

        `link` is the direction that the packet takes, or any other mark for `pop` to return.
        """
        if not arrivals:
            self.lost += 1
            return
        packets = self._packets
        for arrival_ns in arrivals:
            if self._capacity is not None and len(packets) >= self._capacity:
                self.overflow += 1
                continue
            self._sent += 1
            heappush(packets, (arrival_ns, self._sent, link, data))
            self.next_ns = packets[0][0]

    def pop(self) -> tuple[int, Any, Any]:
        """Take the packet that arrives next; at least one must be in flight.

        Returns:
            Its time of arrival [ns], the direction that it took, and its data.
        """
        packets = self._packets
        arrival_ns, _, link, data = heappop(packets)
        self.next_ns = packets[0][0] if packets else NOTHING_NS
        return arrival_ns, link, data
