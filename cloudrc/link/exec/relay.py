"""Carry IP packets between two TUN devices, each one late, lost or copied as the model computes.

The relay wakes shortly before a packet is due and then reads the clock in a loop, as the relay of
a flight does (`cloudrc/link/relay.py`).
"""

from __future__ import annotations

import os
import select
import time
from array import array
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from heapq import heappop, heappush

from cloudrc.link.exec.namespace import MTU
from cloudrc.link.library import KIND
from cloudrc.link.model import HEADER_BYTES, LinkDirection
from cloudrc.link.relay import SPIN_NS, ReleaseErrors

BATCH = 32  # packets that the relay reads from a device before it sends
IN_FLIGHT_BYTES = 64 << 20  # in both directions; a packet beyond that is dropped and counted
LOGGED_MAX = 1_000_000  # packets of a direction that are recorded
LOST = -1  # time of a packet that does not arrive


class PacketLog:
    """What happened to the packets of one direction: an entry per packet in each array.

    Times are on the monotonic clock [ns]. `due` and `left` are LOST for a packet that did not
    arrive. `left` is that of the copy that left first.
    """

    def __init__(self) -> None:
        self.sent, self.size, self.due, self.left = (array("q") for _ in range(4))
        self.copies = array("b")

    def __len__(self) -> int:
        return len(self.sent)

    def enter(self, sent_ns: int, size: int, arrivals: Sequence[int]) -> None:
        """Note the next packet, which is due at `arrivals` [ns]."""
        if len(self.sent) < LOGGED_MAX:
            self.sent.append(sent_ns)
            self.size.append(size)
            self.due.append(min(arrivals) if arrivals else LOST)
            self.left.append(LOST)
            self.copies.append(0)

    def leave(self, number: int, now_ns: int) -> None:
        """Note that a copy of the packet `number` has left."""
        if number < len(self.copies):
            if not self.copies[number]:
                self.left[number] = now_ns
            self.copies[number] += 1


@dataclass(slots=True)
class TunWay:
    """One direction: reads packets from a device, and writes them to the other device."""

    link: LinkDirection
    source: int  # file descriptor of the device where packets enter
    target: int  # file descriptor of the device where packets leave
    log: PacketLog = field(default_factory=PacketLog)
    received: int = 0  # number of packets read
    forwarded: int = 0  # number of packets written, copies included
    lost: int = 0
    overflow: int = 0
    unsent: int = 0
    waited: int = 0  # packets of full batches: how long they waited to be read is not known


class TunRelay:
    """Carries packets in both directions; one thread calls `step`, others the other methods."""

    def __init__(self, ways: Mapping[str, TunWay]) -> None:
        """Set the directions, by name."""
        self.ways = ways
        self._sources = {way.source: way for way in ways.values()}
        # Time due [ns], a number that keeps the order, direction, number of the packet, packet.
        self._packets: list[tuple[int, int, TunWay, int, bytes]] = []
        self._entered = self._bytes = 0
        self.errors = ReleaseErrors()

    @property
    def in_flight(self) -> int:
        """Number of packets that have entered the link and not left it yet."""
        return len(self._packets)

    def drain(self) -> None:
        """Drop the packets that came before the link: the kernel's own, which find nobody."""
        for source in self._sources:
            with suppress(OSError):
                while True:
                    os.read(source, MTU)

    def step(self, timeout: float) -> None:
        """Wait at most `timeout` [s] until packets arrive or are due; read and write them."""
        packets = self._packets
        if packets:
            due_ns = packets[0][0]
            timeout = min(timeout, max(0.0, (due_ns - SPIN_NS - time.monotonic_ns()) * 1e-9))
        readable, _, _ = select.select(self._sources, (), (), timeout)
        if packets and packets[0][0] - time.monotonic_ns() <= SPIN_NS:
            due_ns = packets[0][0]
            while time.monotonic_ns() < due_ns:
                pass
            self._release()
        for source in readable:
            self._take_in(self._sources[source])
        if readable:
            self._release()  # packets without delay

    def _take_in(self, way: TunWay) -> None:
        """Read up to `BATCH` packets from a device, and compute when each is due."""
        read, source, send, log = os.read, way.source, way.link.send, way.log
        for _ in range(BATCH):
            try:
                data = read(source, MTU)
            except OSError:  # no packet waits
                return
            now_ns, number, size = time.monotonic_ns(), way.received, len(data)
            way.received += 1
            # The model counts the bytes of UDP payload, and adds the headers itself.
            arrivals = send(1, KIND, number, size - HEADER_BYTES, now_ns)
            log.enter(now_ns, size, arrivals)
            if not arrivals:
                way.lost += 1
                continue
            if way.link.corrupts:
                data = way.link.corrupted(1, KIND, number, data)
            for due_ns in arrivals:
                if self._bytes > IN_FLIGHT_BYTES:
                    way.overflow += 1
                    continue
                self._entered += 1
                self._bytes += size
                heappush(self._packets, (due_ns, self._entered, way, number, data))
        way.waited += BATCH

    def _release(self) -> None:
        """Write up to `BATCH` packets that are due."""
        packets, write = self._packets, os.write
        for _ in range(BATCH):
            now_ns = time.monotonic_ns()
            if not packets or packets[0][0] > now_ns:
                return
            due_ns, _, way, number, data = heappop(packets)
            self._bytes -= len(data)
            try:
                write(way.target, data)
            except OSError:  # a damaged packet, or the kernel has no memory
                way.unsent += 1
                continue
            way.forwarded += 1
            self.errors.observe(now_ns - due_ns)
            way.log.leave(number, now_ns)
