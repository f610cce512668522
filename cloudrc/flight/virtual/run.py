# SPDX-License-Identifier: Apache-2.0

"""Run world, cloud and the link between them in one process, in virtual time.

The driver handles events in the order of their times, which are integer nanoseconds. If several
events have equal times, it handles arrivals of datagrams first, in the order of sending, then
world's deadline, then cloud's deadline. Therefore equal inputs give bitwise equal runs.
"""

from __future__ import annotations

import gc
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING

from cloudrc.link.model import LinkDirection
from cloudrc.link.queue import PacketQueue
from cloudrc.wire.endpoint import Endpoint
from cloudrc.wire.messages import Datagram, Passed
from cloudrc.wire.records import CellWait, LinkWait, Record
from cloudrc.wire.tunnel.codec import Kind, peek

if TYPE_CHECKING:
    from cloudrc.link.radio import RadioParts

Sink = Callable[[list[Record], list[Record]], None]
"""Function that is called with the new records of world and the new records of cloud."""
CPU_CLOCK = time.thread_time_ns
"""Clock of this thread's processor time [ns]; a flight that depends on it is not repeatable."""
PERIOD_NS = 100_000_000
"""Virtual time between two calls of `sink` and of `until` [ns]."""
WATCHED = Kind.TELEMETRY, Kind.COMMAND
"""Kinds of datagrams whose waits are recorded."""


@dataclass(frozen=True, slots=True)
class Clock:
    """Monotonic clock of a simulated machine; it may differ from virtual time."""

    offset_ns: int = 0  # what the clock shows at virtual time 0 [ns]
    drift_ppm: int = 0  # how much faster than virtual time the clock is [ppm]

    def at(self, now_ns: int) -> int:
        """Return the time that this clock shows [ns] at the virtual time `now_ns` [ns]."""
        return now_ns + self.offset_ns + now_ns * self.drift_ppm // 1_000_000

    def when(self, own_ns: int) -> int:
        """Return the first virtual time [ns] at which this clock shows `own_ns` [ns] or more."""
        now_ns = own_ns - self.offset_ns
        if self.drift_ppm:
            now_ns = -(-now_ns * 1_000_000 // (1_000_000 + self.drift_ppm))
        return now_ns


@contextmanager
def without_collections() -> Iterator[None]:
    """Collect no garbage: a flight makes no reference cycles, so that it would waste time."""
    was_on = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        if was_on:
            # The flight's records become old objects at once; else a collection visits them now.
            gc.freeze()
            gc.unfreeze()
            gc.enable()


class _Waits:
    """Records how long telemetry and commands wait on their way.

    It does not know the run, so that a flight makes no reference cycle: nobody would collect it.
    """

    def __init__(self) -> None:
        self._records = list[Record]()

    def take(self) -> list[Record]:
        """Return the records since the last call."""
        records, self._records = self._records, []
        return records

    def note_cell(
        self, uplink: bool, header: tuple[int, int, int], sent_ns: int, now_ns: int
    ) -> None:
        """Record how long telemetry or a command was in the cell."""
        kind, epoch, counter = header
        if kind in WATCHED:
            self._records.append(CellWait(now_ns, uplink, epoch, counter, now_ns - sent_ns))

    def note_link(
        self,
        uplink: bool,
        packet: tuple[int, int, int],
        now_ns: int,
        queue_ns: int,
        radio: RadioParts | None,
    ) -> None:
        """Record where telemetry or a command waits in the link."""
        epoch, kind, counter = packet
        if kind in WATCHED:
            waits_ns = queue_ns, *(radio or (0, 0, 0))
            self._records.append(LinkWait(now_ns, uplink, epoch, counter, *waits_ns))


class VirtualRun:
    """Runs world, cloud and both directions of the link, in virtual time that starts at 0.

    World's clock is virtual time, and so is `cloud_clock` by default.
    """

    def __init__(
        self,
        world: Endpoint,
        cloud: Endpoint,
        uplink: LinkDirection,
        downlink: LinkDirection,
        *,
        cloud_clock: Clock = Clock(),
        in_flight: PacketQueue | None = None,
    ) -> None:
        """Connect the ends; `in_flight` is a queue that lets packets pass a cell first."""
        self._world, self._cloud = world, cloud
        self._uplink, self._downlink = uplink, downlink
        self.cloud_clock = cloud_clock
        self.in_flight = PacketQueue() if in_flight is None else in_flight
        self.now_ns = 0
        self._waits = waits = _Waits()
        self.in_flight.watch = waits.note_cell
        uplink.watch = partial(waits.note_link, True)
        downlink.watch = partial(waits.note_link, False)

    def fly(self, until: Callable[[], bool], limit_ns: int, sink: Sink) -> None:
        """Run until `until()` is true or virtual time reaches `limit_ns` [ns].

        Every 100 ms of virtual time, call `sink` with the new records, and then `until`.
        """
        with without_collections():
            while self.now_ns < limit_ns:
                self.advance(min(self.now_ns + PERIOD_NS, limit_ns))
                sink(*self.take_records())
                if until():
                    return

    def take_records(self) -> tuple[list[Record], list[Record]]:
        """Return the new records of world and of cloud."""
        return self._world.take_records() + self._waits.take(), self._cloud.take_records()

    @property
    def next_ns(self) -> int:
        """Time of the next event [ns]."""
        cloud_ns = self.cloud_clock.when(self._cloud.next_deadline_ns())
        return min(self.in_flight.next_ns, self._world.next_deadline_ns(), cloud_ns)

    def on_world_clock(self, from_cloud: list[Record]) -> list[Record]:
        """Convert the stamps of cloud's records [ns] to virtual time, which is world's clock."""
        if self.cloud_clock == Clock():
            return from_cloud
        when = self.cloud_clock.when
        return [record._replace(stamp_ns=when(record.stamp_ns)) for record in from_cloud]

    def advance(self, end_ns: int) -> None:
        """Handle all events up to and including `end_ns` [ns]."""
        world, cloud, in_flight = self._world, self._cloud, self.in_flight
        clock = None if self.cloud_clock == Clock() else self.cloud_clock  # None takes less time
        world_ns, cloud_ns = world.next_deadline_ns(), cloud.next_deadline_ns()
        cloud_ns = clock.when(cloud_ns) if clock else cloud_ns
        while True:
            deadline_ns = world_ns if world_ns <= cloud_ns else cloud_ns
            if in_flight.next_ns <= deadline_ns:
                if in_flight.next_ns > end_ns:
                    break
                self.now_ns, link, data = in_flight.pop()
                if to_world := link is self._downlink:
                    world.receive_datagram(data, self.now_ns)
                else:
                    cloud.receive_datagram(data, clock.at(self.now_ns) if clock else self.now_ns)
            elif deadline_ns > end_ns:
                break
            else:
                self.now_ns = deadline_ns
                if to_world := world_ns <= cloud_ns:
                    world.handle_deadline(deadline_ns)
                else:
                    cloud.handle_deadline(clock.at(deadline_ns) if clock else deadline_ns)
            if to_world:
                world_ns = world.next_deadline_ns()
                if datagrams := world.take_datagrams():
                    self._send(datagrams, self._uplink)
            else:
                cloud_ns = cloud.next_deadline_ns()
                cloud_ns = clock.when(cloud_ns) if clock else cloud_ns
                if datagrams := cloud.take_datagrams():
                    self._send(datagrams, self._downlink)
        self.now_ns = end_ns

    def _send(self, datagrams: list[Datagram], link: LinkDirection) -> None:
        for data in datagrams:
            if type(data) is Passed:
                header, size = data[:3], data.size
            else:
                header, size = peek(data), len(data)
            self.in_flight.send(link, header, size, data, self.now_ns)
