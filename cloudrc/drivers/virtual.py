"""Run world, cloud and the link between them in one process, in virtual time.

The driver handles events in the order of their times, which are integer nanoseconds. If several
events have equal times, it handles arrivals of datagrams first, in the order of sending, then
world's deadline, then cloud's deadline. Therefore equal inputs give bitwise equal runs.
"""

from __future__ import annotations

import gc
from collections.abc import Callable
from heapq import heappop, heappush

from cloudrc.endpoint import Endpoint
from cloudrc.link.model import LinkDirection
from cloudrc.messages import Datagram, Passed
from cloudrc.records import Record
from cloudrc.tunnel.codec import SIZES, peek

Sink = Callable[[list[Record], list[Record]], None]
"""Function that is called with the new records of world and the new records of cloud."""
PERIOD_NS = 100_000_000
"""Virtual time between two calls of `sink` and of `until` [ns]."""


class VirtualRun:
    """Runs world, cloud and both directions of the link, in virtual time that starts at 0."""

    def __init__(
        self,
        world: Endpoint,
        cloud: Endpoint,
        uplink: LinkDirection,
        downlink: LinkDirection,
        *,
        cloud_clock_offset_ns: int = 0,
    ) -> None:
        """Connect the parts; cloud's clock is ahead of world's by `cloud_clock_offset_ns` [ns]."""
        self._world, self._cloud = world, cloud
        self._uplink, self._downlink = uplink, downlink
        self._offset_ns = cloud_clock_offset_ns
        self._arrivals: list[tuple[int, int, bool, Datagram]] = []
        self._sent = 0
        self.now_ns = 0

    def fly(self, until: Callable[[], bool], limit_ns: int, sink: Sink) -> None:
        """Run until `until()` is true or virtual time reaches `limit_ns` [ns].

        Every 100 ms of virtual time, call `sink` with the new records, and then `until`.
        """
        gc_was_on = gc.isenabled()
        gc.disable()  # a flight makes no reference cycles, so that collections would waste time
        try:
            while self.now_ns < limit_ns:
                self._advance(min(self.now_ns + PERIOD_NS, limit_ns))
                sink(self._world.take_records(), self._cloud.take_records())
                if until():
                    return
        finally:
            if gc_was_on:
                gc.enable()

    def _advance(self, end_ns: int) -> None:
        """Handle all events up to and including `end_ns` [ns]."""
        world, cloud, offset_ns = self._world, self._cloud, self._offset_ns
        arrivals = self._arrivals
        world_ns, cloud_ns = world.next_deadline_ns(), cloud.next_deadline_ns() - offset_ns
        while True:
            deadline_ns = world_ns if world_ns <= cloud_ns else cloud_ns
            if arrivals and arrivals[0][0] <= deadline_ns:
                if arrivals[0][0] > end_ns:
                    break
                self.now_ns, _, to_world, data = heappop(arrivals)
                if to_world:
                    world.receive_datagram(data, self.now_ns)
                else:
                    cloud.receive_datagram(data, self.now_ns + offset_ns)
            elif deadline_ns > end_ns:
                break
            else:
                self.now_ns = deadline_ns
                if to_world := world_ns <= cloud_ns:
                    world.handle_deadline(deadline_ns)
                else:
                    cloud.handle_deadline(deadline_ns + offset_ns)
            if to_world:
                world_ns = world.next_deadline_ns()
                if datagrams := world.take_datagrams():
                    self._send(datagrams, self._uplink, to_world=False)
            else:
                cloud_ns = cloud.next_deadline_ns() - offset_ns
                if datagrams := cloud.take_datagrams():
                    self._send(datagrams, self._downlink, to_world=True)
        self.now_ns = end_ns

    def _send(self, datagrams: list[Datagram], link: LinkDirection, *, to_world: bool) -> None:
        for data in datagrams:
            if type(data) is Passed:
                kind, epoch, counter, _ = data
                size = SIZES[kind]
            else:
                (kind, epoch, counter), size = peek(data), len(data)
            arrivals = link.send(epoch, kind, counter, size, self.now_ns)
            if link.corrupts and arrivals:
                data = link.corrupted(epoch, kind, counter, data)
            for arrival_ns in arrivals:
                self._sent += 1
                heappush(self._arrivals, (arrival_ns, self._sent, to_world, data))
