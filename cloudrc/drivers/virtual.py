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
    """One direction of the emulated network."""

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
        world, cloud, flying, offset_ns = self._world, self._cloud, self._flying, self._offset_ns
        asked_ns = self.now_ns
        while self.now_ns < limit_ns:
            world_ns = world.next_deadline_ns()
            cloud_ns = cloud.next_deadline_ns() - offset_ns
            if flying and flying[0][0] <= world_ns and flying[0][0] <= cloud_ns:
                self._deliver()
            elif world_ns <= cloud_ns:
                self.now_ns = world_ns
                world.handle_deadline(world_ns)
                self._send_up()
            else:
                self.now_ns = cloud_ns
                cloud.handle_deadline(cloud_ns + offset_ns)
                self._send_down()
                if cloud_ns >= asked_ns + PERIOD_NS:
                    asked_ns = cloud_ns
                    sink(world.take_records(), cloud.take_records())
                    if until():
                        return
        sink(world.take_records(), cloud.take_records())

    def _deliver(self) -> None:
        self.now_ns, _, to_world, data = heappop(self._flying)
        if to_world:
            self._world.receive_datagram(data, self.now_ns)
            self._send_up()
        else:
            self._cloud.receive_datagram(data, self.now_ns + self._offset_ns)
            self._send_down()

    def _send_up(self) -> None:
        for data in self._world.take_datagrams():
            self._send(data, self._uplink, to_world=False)

    def _send_down(self) -> None:
        for data in self._cloud.take_datagrams():
            self._send(data, self._downlink, to_world=True)

    def _send(self, data: bytes, link: Link, *, to_world: bool) -> None:
        kind, epoch, counter = peek(data)
        for arrival_ns in link.send(epoch, kind, counter, len(data), self.now_ns):
            self._sent += 1
            heappush(self._flying, (arrival_ns, self._sent, to_world, data))
