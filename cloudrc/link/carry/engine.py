# SPDX-License-Identifier: Apache-2.0

"""Take packets in at a port, and hand each one on when the link's model says so.

The engine never hands a packet on before it is due. A sleeping thread wakes 15 to 50 us late; so
the engine sleeps until shortly before the next packet is due, and then reads the clock in a loop.
"""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from typing import Any, NamedTuple, Protocol

from cloudrc.link.carry.log import PacketLog, ReleaseErrors
from cloudrc.link.model import HEADER_BYTES, LinkDirection
from cloudrc.link.profile import DirectionProfile
from cloudrc.link.queue import PacketQueue

BATCH = 32  # packets that a port takes before the engine sends, and sent before it takes again
SPIN_NS = 60_000  # the engine reads the clock in a loop for this time before a packet is due [ns]


@dataclass(slots=True, eq=False)
class LinkWay:
    """One direction of the link, and what happened to its packets."""

    link: LinkDirection
    give: Callable[[Any], bool]  # hands a packet's data on; returns whether that was possible
    log: PacketLog = field(default_factory=PacketLog)
    checked: bool = False  # whether a damaged packet is lost, as behind a checksum
    received: int = 0  # number of packets that have entered
    first: int = 0  # number of the first packet since the profile has changed
    waited: int = 0  # packets of full batches: how long they waited to be read is not known

    def replace_profile(
        self, profile: DirectionProfile, *, restart: bool = False, start_ns: int = 0
    ) -> None:
        """Use another profile from the next packet on, as `LinkDirection.replace_profile`."""
        self.link.replace_profile(profile, restart=restart, start_ns=start_ns)
        self.first = self.received


class Packet(NamedTuple):
    """A packet that has come to a port."""

    way: LinkWay
    header: tuple[int, int, int]  # kind, epoch and counter, which select its random numbers
    size: int  # of the UDP payload [bytes]
    data: Any
    time_ns: int  # of arrival, monotonic clock [ns]


class Port(Protocol):
    """Where packets enter."""

    def wait(self, until_ns: int) -> bool:
        """Wait until packets have come, or until a time [ns]; return whether some have come."""

    def take(self) -> Iterator[Packet]:
        """Yield packets that have come, at most `BATCH` of each direction."""


class Engine:
    """Carries the packets of a port. One thread calls `step`.

    Attributes:
        queue: What is due when: calls with their arguments, which get the time too.
        changes: Functions that another thread wants the engine to call.
        forwarded: Number of packets handed on, copies included.
        unsent: Number of packets that could not be handed on.
        errors: How late packets were handed on.
    """

    def __init__(self, port: Port, ways: Sequence[LinkWay], capacity: int | None = None) -> None:
        """Carry the packets of `ways`; at most `capacity` copies are on the link."""
        self._port, self._ways = port, ways
        self.queue = PacketQueue(capacity)
        self.changes = deque[Callable[[], None]]()
        self.forwarded = self.unsent = 0
        self.errors = ReleaseErrors()

    def step(self, timeout: float) -> None:
        """Wait at most `timeout` [s] until packets come or are due; take and hand them on."""
        while self.changes:
            self.changes.popleft()()
        due_ns = self.queue.next_ns
        until_ns = time.monotonic_ns() + round(timeout * 1e9)
        has_come = self._port.wait(min(until_ns, due_ns - SPIN_NS))
        if due_ns - time.monotonic_ns() <= SPIN_NS:
            while time.monotonic_ns() < due_ns:
                pass
            self._release()  # before taking: what has come can wait
        if has_come:
            self.take_in()
            self._release()  # packets without delay

    def take_in(self) -> None:
        """Take packets from the port, and compute when each is due."""
        put, leave = self.queue.put, self.leave
        for way, (kind, epoch, counter), size, data, now_ns in self._port.take():
            link, number = way.link, way.received
            way.received += 1
            arrivals = link.send(epoch, kind, counter, size, now_ns)
            if arrivals and link.corrupts:
                damaged = link.corrupted(epoch, kind, counter, data)
                if way.checked and damaged != data:
                    arrivals = ()
                data = damaged
            way.log.enter(now_ns, size + HEADER_BYTES, arrivals)
            put(leave, arrivals, (way, number, data))

    def _release(self) -> None:
        """Make up to `BATCH` calls that are due."""
        queue, clock = self.queue, time.monotonic_ns
        for _ in range(BATCH):
            if queue.next_ns > clock():
                return
            due_ns, call, arguments = queue.pop()
            call(*arguments, due_ns)

    def leave(self, way: LinkWay, number: int, data: Any, due_ns: int) -> None:
        """Hand on the packet with this number of its direction, which is due."""
        now_ns = time.monotonic_ns()
        if not way.give(data):
            self.unsent += 1
            return
        self.forwarded += 1
        self.errors.observe(now_ns - due_ns)
        way.log.leave(number, now_ns)

    def counts(self) -> dict[str, int]:
        """Return the number of packets by outcome."""
        return {
            "received": sum(way.received for way in self._ways),
            "forwarded": self.forwarded,
            "lost": self.queue.lost,
            "overflow": self.queue.overflow,
            "unsent": self.unsent,
        }
