# SPDX-License-Identifier: Apache-2.0

"""Carry IP packets between two TUN devices."""

from __future__ import annotations

import os
import select
import time
from collections.abc import Iterator, Mapping

from cloudrc.link.carry.engine import BATCH, LinkWay, Packet
from cloudrc.link.exec.namespace import MTU
from cloudrc.link.library import KIND
from cloudrc.link.model import HEADER_BYTES

IN_FLIGHT_MAX = 50_000  # packets in both directions, 75 MB at most; more are dropped and counted


def write_packet(device: int, data: bytes) -> bool:
    """Write a packet to a device; the kernel takes no damaged one, or has no memory."""
    try:
        os.write(device, data)
    except OSError:
        return False
    return True


class TunPort:
    """Reads the packets of each direction from a device."""

    def __init__(self, devices: Mapping[int, LinkWay]) -> None:
        """Set the file descriptors of the devices where the packets of each direction enter."""
        self._devices = devices
        self._readable: list[int] = []

    def drain(self) -> None:
        """Drop the packets that came before the link: the kernel's own, which find nobody."""
        while self.wait(0):
            for _ in self.take():
                pass

    def wait(self, until_ns: int) -> bool:
        """Wait until a device can be read, or until a time [ns]; return whether one can."""
        timeout = max(0.0, (until_ns - time.monotonic_ns()) * 1e-9)
        self._readable, _, _ = select.select(self._devices, (), (), timeout)
        return bool(self._readable)

    def take(self) -> Iterator[Packet]:
        """Read up to `BATCH` packets from each device."""
        read, clock = os.read, time.monotonic_ns
        for source in self._readable:
            way = self._devices[source]
            for _ in range(BATCH):
                try:
                    data = read(source, MTU)
                except OSError:  # no packet waits
                    break
                # The model counts the bytes of UDP payload, and adds the headers itself.
                size = len(data) - HEADER_BYTES
                yield Packet(way, (KIND, 1, way.received), size, data, clock())
            else:
                way.waited += BATCH
