# SPDX-License-Identifier: Apache-2.0

"""Carry messages of any size over one direction of the link: in one packet, or in several."""

from __future__ import annotations

from cloudrc.link.carry.engine import Engine, LinkWay, Packet
from cloudrc.link.carry.log import PENDING
from cloudrc.link.carry.tcp.medium import Medium
from cloudrc.link.carry.tcp.stream import MessageStream
from cloudrc.link.library import PACKET_BYTES, Cut
from cloudrc.link.model import HEADER_BYTES
from cloudrc.link.profile import DirectionProfile

EPOCH = 1
"""Epoch of all packets."""
UNREPAIRED_MAX = 100
"""Messages of a stream that wait or are repaired; a message beyond that is dropped and counted."""


class MessageWay:
    """The messages of one direction. The first one decides how their packets are counted.

    A message of one packet is one of `take`'s. Without `media`, a larger one arrives when its last
    packet is there, and is lost if one packet is lost. With `media`, losses are repaired from the
    first larger message on, and all messages arrive in order.
    """

    def __init__(
        self, engine: Engine, way: LinkWay, media: tuple[Medium, Medium] | None = None
    ) -> None:
        """Carry messages; `media` is the direction, and that of the acknowledgements."""
        self._engine, self._way, self._media = engine, way, media
        self._cut: Cut | None = None
        self._stream: MessageStream | None = None
        self._delivered = self._given = 0  # messages of the stream

    def replace_profile(
        self, profile: DirectionProfile, *, restart: bool = False, start_ns: int = 0
    ) -> None:
        """Use another profile from the next packet on, as `LinkDirection.replace_profile`."""
        for each in (self._way, *(self._media or ())[:1]):
            each.replace_profile(profile, restart=restart, start_ns=start_ns)

    def take(self, data: bytes, now_ns: int) -> Packet | None:
        """Return the packet of a small message; carry any other one."""
        way, size = self._way, len(data)
        if self._cut is None:
            self._cut = Cut().for_size(size)
        if size <= PACKET_BYTES and self._stream is None:
            kind, counter, _ = self._cut.piece(way.received, size, 0)
            return Packet(way, (kind, EPOCH, counter), size, data, now_ns)
        number = way.received
        way.received += 1
        on_wire = size + self._cut.count(size) * HEADER_BYTES
        if self._media:
            self._give(self._media, (number, data), on_wire, now_ns)
            return None
        arrivals, _ = way.link.send_pieces(EPOCH, self._cut.pieces(number, size), now_ns)
        way.log.enter(now_ns, on_wire, arrivals)
        self._engine.queue.put(self._engine.leave, arrivals, (way, number, data))
        return None

    def _give(
        self, media: tuple[Medium, Medium], message: tuple[int, bytes], on_wire: int, now_ns: int
    ) -> None:
        """Give a message with its number to the stream, which begins with the first one."""
        log, queue = self._way.log, self._engine.queue
        if self._given - self._delivered >= UNREPAIRED_MAX:
            queue.overflow += 1
            log.enter(now_ns, on_wire, ())
            return
        if self._stream is None:
            assert self._cut is not None
            self._stream = MessageStream(queue, media, EPOCH, self._cut, self._deliver)
        self._given += 1
        log.enter(now_ns, on_wire, (PENDING,))
        number, data = message
        self._stream.send(number, len(data), message, now_ns)

    def _deliver(self, message: tuple[int, bytes], due_ns: int) -> None:
        self._delivered += 1
        number, data = message
        self._way.log.arrive(number, due_ns)
        self._engine.leave(self._way, number, data, due_ns)
