"""Run several robots in virtual time, which act on each other through a cell and a shared cloud.

Each robot is a `VirtualRun`. It may fly on alone up to the next instant at which others can act on
it: no packet arrives earlier than the next one can leave the cell, plus the shortest delay behind
the cell, and no computation ends earlier than the shortest one takes. The cell and the cloud then
catch up. So a robot handles many events in a row, which keeps it in the processor's caches.

Events of equal time have a fixed order: departures, arrivals in the order of their departures,
worlds, clouds, each by the number of the robot.
"""

from __future__ import annotations

import gc
from bisect import insort
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from heapq import heapreplace
from typing import Any, Literal, Protocol

from cloudrc.drivers.virtual import PERIOD_NS, Sink, VirtualRun
from cloudrc.link.cell import Cell, CellPacket
from cloudrc.link.model import HEADER_BYTES, LinkDirection
from cloudrc.link.queue import NOTHING_NS, PacketQueue


class CellQueue(PacketQueue):
    """The packets of a robot in flight behind a cell; new ones are sent through the cell."""

    def __init__(
        self, robot: int, cells: Sequence[Cell], orders: Sequence[bool], downlink: LinkDirection
    ) -> None:
        """Set the robot's number, the cells of both ways, and which ways keep the order."""
        super().__init__()
        self._robot, self._cells, self._orders = robot, cells, orders
        self._downlink = downlink
        self._last_ns, self._numbers = [0, 0], 0

    def send(
        self, link: LinkDirection, header: tuple[int, int, int], size: int, data: Any, now_ns: int
    ) -> None:
        """Send a packet through the cell, unless the link loses it; each copy takes its place."""
        kind, epoch, counter = header
        arrivals = link.send(epoch, kind, counter, size, now_ns)
        if arrivals and link.corrupts:
            data = link.corrupted(epoch, kind, counter, data)
        way, whole = int(link is self._downlink), size + HEADER_BYTES
        for arrival_ns in arrivals:
            self._numbers += 1
            what = self._robot, self._numbers, kind, whole, arrival_ns - now_ns, (link, data)
            self._cells[way].inbox.append(CellPacket(now_ns, way, *what))

    def take(self, packet: CellPacket) -> None:
        """Take a packet that has left the cell at its `sent_ns`."""
        arrival_ns, way = packet.sent_ns + packet.delay_ns, packet.way
        if self._orders[way]:
            arrival_ns = self._last_ns[way] = max(arrival_ns, self._last_ns[way])
        link, data = packet.data
        self.put(link, (arrival_ns,), data)


class Computing(Protocol):
    """A cloud whose computations wait for a core."""

    shortest_ns: int  # duration of its next computation on a core of its own [ns]
    begun: tuple[int, int] | None  # begin and duration of a new computation [ns]
    finish: Callable[[int], None]  # lets the computation end at a time [ns]


class SharedCores:
    """Cores on which the clouds of robots compute.

    Attributes:
        busy_ns: Time of all computations, each on a core of its own [ns].
        count: Number of computations.
    """

    def __init__(self, cores: int, sharing: Literal["fifo", "ps"]) -> None:
        """Create idle cores; comments in `config.schema.Cloud` describe the ways of sharing."""
        self.cores, self._is_fifo = cores, sharing == "fifo"
        self._free_ns = [0] * cores  # when each core is free [ns], a heap
        # Processor sharing: `_work` grows as the part of a core that each computation has; a
        # computation ends when it has grown by its duration.
        self._active: list[tuple[float, int]] = []  # `_work` at the end [ns] and robot
        self._work, self._now_ns = 0.0, 0
        self.busy_ns = self.count = 0

    @property
    def next_ns(self) -> int:
        """When the next computation ends [ns], if none begins before; `NOTHING_NS` if unknown."""
        if not self._active:
            return NOTHING_NS
        left = max(0.0, self._active[0][0] - self._work) / self._share
        return self._now_ns + -int(-left // 1)

    @property
    def _share(self) -> float:
        return min(1.0, self.cores / len(self._active))

    def advance(self, begun: list[tuple[int, int, int]], until_ns: int) -> list[tuple[int, int]]:
        """Take the computations begun before `until_ns` [ns]: time [ns], robot, duration [ns].

        Return robot and end [ns] of the computations whose end is known now.
        """
        ended = list[tuple[int, int]]()
        for now_ns, robot, duration_ns in sorted(begun):
            self.busy_ns += duration_ns
            self.count += 1
            if self._is_fifo:
                end_ns = max(now_ns, self._free_ns[0]) + duration_ns
                heapreplace(self._free_ns, end_ns)
                ended.append((robot, end_ns))
            else:
                self._pass(now_ns)
                insort(self._active, (self._work + duration_ns, robot))
        while self.next_ns <= until_ns:
            self._pass(self.next_ns)
            ended.append((self._active.pop(0)[1], self._now_ns))
        return ended

    def _pass(self, now_ns: int) -> None:
        if self._active:
            self._work += (now_ns - self._now_ns) * self._share
        self._now_ns = now_ns


@dataclass(frozen=True, slots=True)
class Member:
    """A robot of a fleet."""

    run: VirtualRun
    compute: Computing | None  # None if its cloud shares no cores
    over: Callable[[], bool]  # whether its mission is over
    limit_ns: int  # time after which its flight is stopped [ns]
    sink: Sink


class FleetRun:
    """Runs the robots of a fleet, in virtual time that starts at 0."""

    def __init__(
        self,
        members: Sequence[Member],
        cells: Sequence[Cell] = (),
        cores: SharedCores | None = None,
        delay_ns: int = 0,
    ) -> None:
        """Set the robots, the cells, and the shortest delay behind these, `delay_ns` [ns]."""
        self._members, self._cells, self._cores = members, cells, cores
        self._delay_ns = delay_ns
        self._next_ns = [member.run.next_ns for member in members]
        self.now_ns = 0

    def fly(self, look: Callable[[int], None] = lambda now_ns: None) -> None:
        """Fly until the missions of all robots are over, or until the limit of each.

        Every 100 ms of virtual time, call the sinks of the robots whose flight is not over. In a
        cell these robots go on sending. `look` is then called with the time [ns].
        """
        if not self._cells and self._cores is None:
            for each in self._members:  # nobody acts on the others
                each.run.fly(each.over, each.limit_ns, each.sink)
            return
        flying, gc_was_on = [*self._members], gc.isenabled()
        gc.disable()
        try:
            while flying:
                self._advance(self.now_ns + PERIOD_NS)
                for each in self._members:
                    records = each.run.take_records()
                    if each in flying:
                        each.sink(*records)
                flying = [
                    each for each in flying if self.now_ns < each.limit_ns and not each.over()
                ]
                look(self.now_ns)
        finally:
            if gc_was_on:
                gc.enable()

    def _advance(self, end_ns: int) -> None:
        """Handle all events up to and including `end_ns` [ns]."""
        while True:
            now_ns = min([*self._next_ns, *(cell.next_ns for cell in self._cells)])
            if self._cores is not None:
                now_ns = min(now_ns, self._cores.next_ns)
            if now_ns > end_ns:
                self.now_ns = end_ns
                return
            until_ns = min(self._horizon_ns(now_ns), end_ns + 1)
            for number, next_ns in enumerate(self._next_ns):
                if next_ns < until_ns:
                    run = self._members[number].run
                    run.advance(until_ns - 1)
                    self._next_ns[number] = run.next_ns
            for cell in self._cells:
                for packet in cell.advance(until_ns):
                    self._take(packet)
            if self._cores is not None:
                self._compute(self._cores, until_ns)

    def _horizon_ns(self, now_ns: int) -> int:
        """Return the time up to which each robot may fly on alone from `now_ns` [ns]."""
        until_ns = NOTHING_NS
        for cell in self._cells:
            until_ns = min(until_ns, cell.soonest_ns(now_ns) + self._delay_ns)
        if self._cores is not None:
            shortest = min(m.compute.shortest_ns for m in self._members if m.compute)
            until_ns = min(until_ns, now_ns + shortest, self._cores.next_ns)
        # If nothing takes time, go on by 1 ns at least, but first let leave what leaves now.
        ends_ns = [self._cores.next_ns] if self._cores else []
        ends_ns += [cell.done_ns for cell in self._cells]
        return until_ns if min(ends_ns) <= now_ns else max(until_ns, now_ns + 1)

    def _take(self, packet: CellPacket) -> None:
        queue = self._members[packet.flow].run.in_flight
        assert isinstance(queue, CellQueue), "a fleet in a cell has such queues"
        queue.take(packet)
        self._next_ns[packet.flow] = min(self._next_ns[packet.flow], queue.next_ns)

    def _compute(self, cores: SharedCores, until_ns: int) -> None:
        begun = list[tuple[int, int, int]]()
        for number, member in enumerate(self._members):
            if member.compute and member.compute.begun:
                now_ns, duration_ns = member.compute.begun
                member.compute.begun = None
                begun.append((now_ns, number, duration_ns))
        for number, end_ns in cores.advance(begun, until_ns):
            member = self._members[number]
            assert member.compute is not None, "all clouds share the cores"
            member.compute.finish(end_ns)
            self._next_ns[number] = member.run.next_ns
