# SPDX-License-Identifier: Apache-2.0

"""Carry the packets of many robots through one cell, in real time.

A packet is lost on its robot's link, or waits in the cell, and is then delayed by the link. The
cell knows only what has been read from the sockets. So it goes on up to the instant at which the
reading began: no earlier packet can follow.
"""

from __future__ import annotations

import select
import selectors
import time
from collections.abc import Iterator, Sequence
from socket import socket
from typing import Any

from cloudrc.link.carry.engine import SPIN_NS, Engine, LinkWay, Packet, Port
from cloudrc.link.carry.udp import Entrance
from cloudrc.link.cell import Cell, CellQueue
from cloudrc.link.model import LinkDirection
from cloudrc.link.queue import NOTHING_NS


class CellPort:
    """Takes in at many sockets, and wakes when the cell has to go on."""

    def __init__(self, cells: Sequence[Cell]) -> None:
        """Create a port without sockets for the cells of both ways, or the one of both."""
        self._cells, self._selector = cells, selectors.DefaultSelector()

    def add(self, one: socket, entrance: Entrance) -> None:
        """Take in at a socket, too, which `entrance` reads."""
        self._selector.register(one, selectors.EVENT_READ, entrance)

    def wait(self, until_ns: int) -> bool:
        """Wait until datagrams have come or packets leave the cell, or until a time [ns].

        Return whether the engine has to take in.
        """
        cell_ns = min(map(_soonest_ns, self._cells))
        timeout = max(0.0, (min(until_ns, cell_ns) - time.monotonic_ns()) * 1e-9)
        # The selector itself waits for whole milliseconds.
        has_come = bool(select.select([self._selector], (), (), timeout)[0])
        return has_come or cell_ns <= time.monotonic_ns()

    def take(self) -> Iterator[Packet]:
        """Read up to `BATCH` datagrams from each socket."""
        for key, _ in self._selector.select(0):
            yield from key.data.take()


class CellEngine(Engine):
    """Carries the packets of robots over each one's link and through the cell of all."""

    def __init__(self, port: Port, cells: Sequence[Cell]) -> None:
        """Set where packets enter, and the cells of uplink and downlink, or the one of both."""
        super().__init__(port, ())
        self._cells, self._known_ns = cells, 0
        self._queues = dict[LinkWay, CellQueue]()

    def join(self, robot: int, ways: tuple[LinkWay, LinkWay], orders: Sequence[bool]) -> None:
        """Add uplink and downlink of a robot; `orders` tells which of them keep the order."""
        links = [way.link for way in ways]

        def onward(link: LinkDirection, arrivals: Sequence[int], data: Any) -> None:
            self.queue.put(self.leave, arrivals, (ways[links.index(link)], 0, data))

        self._ways = (*self._ways, *ways)
        queue = CellQueue(robot, self._cells, orders, links, onward)
        self._queues |= dict.fromkeys(ways, queue)

    def take_in(self) -> None:
        """Take packets from the port; put those on their links that have left the cell."""
        now_ns = time.monotonic_ns()
        for way, header, size, data, sent_ns in self._port.take():
            way.received += 1
            self._queues[way].send(way.link, header, size, data, max(sent_ns, self._known_ns))
        self._known_ns = now_ns
        for cell in self._cells:
            for at_ns, _, leave in cell.advance(now_ns):
                leave(at_ns)


def _soonest_ns(cell: Cell) -> int:
    """Return when a cell has to go on [ns], so that no packet behind it is late."""
    if cell.inbox:
        return 0
    if cell.done_ns == NOTHING_NS:
        return NOTHING_NS
    return max(cell.done_ns, cell.done_ns + cell.delay_ns - 2 * SPIN_NS)
