# SPDX-License-Identifier: Apache-2.0

"""Run several robots in virtual time, which act on each other through a cell and shared cores.

Each robot is a `VirtualRun`. It may fly on alone up to the next instant at which others can act on
it: no packet arrives earlier than the next one can leave the cell, plus the shortest delay behind
the cell, and no computation ends earlier than the shortest one takes. The cell and the cores then
catch up. So a robot handles many events in a row, which keeps it in the processor's caches.

Events of equal time have a fixed order: departures, arrivals in the order of their departures,
worlds, clouds, each by the number of the robot.
"""

from __future__ import annotations

from bisect import insort
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from heapq import heapreplace
from typing import Literal, NamedTuple, Protocol

from cloudrc.flight.virtual.run import PERIOD_NS, Sink, VirtualRun, without_collections
from cloudrc.link.cell import Cell, Usage
from cloudrc.link.queue import NOTHING_NS


class Computation(NamedTuple):
    """A computation that begins; those that begin together keep the order of the fields."""

    begin_ns: int
    robot: int
    duration_ns: int  # on a core of its own
    finish: Callable[[int], None]  # is called with its end [ns]


class Computing(Protocol):
    """A cloud that computes on shared cores."""

    shortest_ns: int  # duration of its next computation on a core of its own [ns]


class SharedCores:
    """Cores on which the clouds of robots compute.

    Attributes:
        inbox: Computations that begin, in any order, for the next `advance`.
        clouds: All clouds that compute here.
        busy_ns: Time of all computations, each on a core of its own [ns].
        count: Number of computations.
    """

    def __init__(self, cores: int, sharing: Literal["fifo", "ps"]) -> None:
        """Create idle cores; `config.cloud.Cloud` describes the ways of sharing."""
        self.cores, self._is_fifo = cores, sharing == "fifo"
        self.inbox, self.clouds = list[Computation](), list[Computing]()
        self._free_ns = [0] * cores  # when each core is free [ns], a heap
        # Processor sharing: `_work` grows as the part of a core that each computation has; a
        # computation ends when it has grown by its duration.
        self._active: list[tuple[float, Computation]] = []  # `_work` at the end [ns]
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

    def soonest_ns(self, now_ns: int) -> int:
        """Return a time before which none ends that begins at `now_ns` or later [ns]."""
        shortest_ns = min(cloud.shortest_ns for cloud in self.clouds)
        return min(self.next_ns, now_ns + max(1, shortest_ns))

    def advance(self, until_ns: int) -> Iterable[tuple[int, int, Callable[[int], None]]]:
        """Take the computations that begin before `until_ns` [ns].

        Yield end [ns], robot and `finish` of the computations whose end is known now.
        """
        begun, self.inbox = sorted(self.inbox), []
        for each in begun:
            self.busy_ns += each.duration_ns
            self.count += 1
            if self._is_fifo:
                end_ns = max(each.begin_ns, self._free_ns[0]) + each.duration_ns
                heapreplace(self._free_ns, end_ns)
                yield end_ns, each.robot, each.finish
            else:
                self._pass(each.begin_ns)
                insort(self._active, (self._work + each.duration_ns, each))
        while self.next_ns <= until_ns:
            self._pass(self.next_ns)
            _, each = self._active.pop(0)
            yield self._now_ns, each.robot, each.finish

    def _pass(self, now_ns: int) -> None:
        if self._active:
            self._work += (now_ns - self._now_ns) * self._share
        self._now_ns = now_ns


@dataclass(frozen=True, slots=True, eq=False)  # no two robots are the same
class Member:
    """A robot of a fleet."""

    run: VirtualRun
    over: Callable[[], bool]  # whether its mission is over
    limit_ns: int  # time after which its flight is stopped [ns]
    sink: Sink


class FleetRun:
    """Runs the robots of a fleet, in virtual time that starts at 0.

    Attributes:
        log: What the cells have done in each 100 ms.
    """

    def __init__(
        self, members: Sequence[Member], cells: Sequence[Cell], cores: SharedCores | None
    ) -> None:
        """Set the robots and what they share."""
        self.members, self.cells, self.cores = members, cells, cores
        self._media: tuple[Cell | SharedCores, ...] = (*cells, *([cores] if cores else []))
        self._next_ns = [member.run.next_ns for member in members]
        self.now_ns, self.log = 0, list[Usage]()

    def fly(self, is_over: Callable[[int], bool] = lambda now_ns: False) -> None:
        """Fly until the missions of all robots are over, or until the limit of each.

        Every 100 ms of virtual time, call the sinks of the robots whose flight is not over. If the
        robots share something, the others go on, until `is_over`, which gets the time [ns], says
        that the flight of all is over.
        """
        if not self._media:
            for each in self.members:  # nobody acts on the others
                each.run.fly(each.over, each.limit_ns, each.sink)
                self.now_ns = max(self.now_ns, each.run.now_ns)
            return
        flying = [*self.members]
        with without_collections():
            while flying:
                self._advance(self.now_ns + PERIOD_NS)
                for each in self.members:
                    records = each.run.take_records()
                    if each in flying:
                        each.sink(*records)
                flying = [
                    each for each in flying if self.now_ns < each.limit_ns and not each.over()
                ]
                self.log += (cell.end_period(self.now_ns) for cell in self.cells)
                if is_over(self.now_ns):
                    return

    def _advance(self, end_ns: int) -> None:
        """Handle all events up to and including `end_ns` [ns]."""
        while True:
            now_ns = min([*self._next_ns, *(medium.next_ns for medium in self._media)])
            if now_ns > end_ns:
                self.now_ns = end_ns
                return
            until_ns = min([end_ns + 1, *(medium.soonest_ns(now_ns) for medium in self._media)])
            for number, next_ns in enumerate(self._next_ns):
                if next_ns < until_ns:
                    run = self.members[number].run
                    run.advance(until_ns - 1)
                    self._next_ns[number] = run.next_ns
            for medium in self._media:
                for at_ns, number, happen in medium.advance(until_ns):
                    happen(at_ns)
                    self._next_ns[number] = self.members[number].run.next_ns
