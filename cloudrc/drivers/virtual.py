"""Virtual time: both ends and the link between them in one process, as fast as it goes.

An event heap in integer nanoseconds. Of several events at one instant, arrivals come first, in the
order in which they were sent, then world's deadline, then cloud's: the same inputs give the same
run, bit by bit.
"""

from __future__ import annotations

import gc
from collections.abc import Callable
from heapq import heappop, heappush
from typing import Protocol

from cloudrc.endpoint import Endpoint
from cloudrc.records import Record
from cloudrc.tunnel.codec import peek

Sink = Callable[[list[Record], list[Record]], None]
"""Takes the records of world and of cloud since the last call."""
PERIOD_NS = 100_000_000
"""How often records are handed over, and whether it is over is asked [ns]."""


class Link(Protocol):
    """One direction of the emulated network.

    Attributes:
        corrupts: Whether `corrupted` is to be asked.
    """

    corrupts: bool

    def corrupted(self, epoch: int, kind: int, counter: int, data: bytes) -> bytes:
        """Give the datagram as it arrives, damaged or not."""

    def send(self, epoch: int, kind: int, counter: int, size: int, now_ns: int) -> tuple[int, ...]:
        """When the copies of this datagram arrive [ns]: none, one or two."""


class VirtualRun:
    """World, cloud and two links, driven through virtual time."""

    def __init__(
        self,
        world: Endpoint,
        cloud: Endpoint,
        uplink: Link,
        downlink: Link,
        *,
        cloud_clock_offset_ns: int = 0,
    ) -> None:
        """Join the parts; time begins at 0.

        Args:
            world: Its clock is virtual time.
            cloud: Its clock is virtual time plus the offset.
            uplink: World to cloud.
            downlink: Cloud to world.
            cloud_clock_offset_ns: Cloud's clock minus world's [ns].
        """
        self._world, self._cloud = world, cloud
        self._uplink, self._downlink = uplink, downlink
        self._offset_ns = cloud_clock_offset_ns
        self._flying: list[tuple[int, int, bool, bytes]] = []
        self._sent = 0
        self.now_ns = 0

    def fly(self, until: Callable[[], bool], limit_ns: int, sink: Sink) -> None:
        """Go on until `until()` is true, asked every 100 ms of virtual time, or to the limit.

        Args:
            until: Whether it is over.
            limit_ns: Virtual time at which it is over in any case [ns].
            sink: Gets all records, every 100 ms of virtual time.
        """
        collects = gc.isenabled()
        gc.disable()  # a flight makes no cycles, and its records would be looked at over and over
        try:
            self._fly(until, limit_ns, sink)
        finally:
            if collects:
                gc.enable()

    def _fly(self, until: Callable[[], bool], limit_ns: int, sink: Sink) -> None:
        while self.now_ns < limit_ns:
            self._advance(min(self.now_ns + PERIOD_NS, limit_ns))
            sink(self._world.take_records(), self._cloud.take_records())
            if until():
                return

    def _advance(self, end_ns: int) -> None:
        """Let happen what is due up to and including `end_ns` [ns], one event after the other."""
        world, cloud, flying, offset_ns = self._world, self._cloud, self._flying, self._offset_ns
        world_ns, cloud_ns = world.next_deadline_ns(), cloud.next_deadline_ns() - offset_ns
        while True:
            deadline_ns = world_ns if world_ns <= cloud_ns else cloud_ns
            if flying and flying[0][0] <= deadline_ns:
                if flying[0][0] > end_ns:
                    break
                self.now_ns, _, to_world, data = heappop(flying)
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

    def _send(self, datagrams: list[bytes], link: Link, *, to_world: bool) -> None:
        for data in datagrams:
            kind, epoch, counter = peek(data)
            arrivals = link.send(epoch, kind, counter, len(data), self.now_ns)
            if link.corrupts and arrivals:
                data = link.corrupted(epoch, kind, counter, data)
            for arrival_ns in arrivals:
                self._sent += 1
                heappush(self._flying, (arrival_ns, self._sent, to_world, data))
