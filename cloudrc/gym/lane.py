# SPDX-License-Identifier: Apache-2.0

"""Send the messages of one direction over the link of an episode, and count them."""

from __future__ import annotations

from collections.abc import Callable
from math import nan
from typing import Any, NamedTuple

from cloudrc.link.carry.tcp.medium import Medium
from cloudrc.link.carry.tcp.stream import MessageStream, run_due
from cloudrc.link.library import KIND, Cut, LinkProfile, OneWay
from cloudrc.link.model import HEADER_BYTES
from cloudrc.link.opportunities import BYTES as OPPORTUNITY_BYTES
from cloudrc.link.profile import DirectionProfile, LinkSchedule
from cloudrc.link.queue import PacketQueue

DATAGRAMS, STREAM = "datagrams", "stream"
DELIVERIES = (DATAGRAMS, STREAM)
"""How messages arrive: whole if no packet is lost; or all, in order, and some of them late."""


class Wire(NamedTuple):
    """What decides how the messages of one direction arrive, but for their random numbers."""

    link: LinkProfile
    uplink: bool  # whether they leave the robot
    size: int  # of a message, usually [bytes]
    delivery: str  # one of DELIVERIES
    packet_bytes: int  # most bytes of a packet

    @property
    def profile(self) -> DirectionProfile:
        """The direction's own profile."""
        return self.link.uplink if self.uplink else self.link.downlink

    @property
    def asked_uplink(self) -> bool:
        """Whether what it asks for has the random numbers of an uplink; with a radio, its own."""
        return self.uplink or self.profile.radio is None

    @property
    def cut(self) -> Cut:
        """How messages are cut into packets."""
        return Cut(self.packet_bytes).for_size(self.size)

    @property
    def is_plain(self) -> bool:
        """Whether a usual message is one packet that nobody repairs."""
        return self.delivery == DATAGRAMS and self.size <= self.packet_bytes

    @property
    def bits(self) -> int:
        """Size of a usual message with the headers of its packets [bit]."""
        return 8 * (self.size + self.cut.usual * HEADER_BYTES)

    @property
    def rates(self) -> tuple[float, ...]:
        """Rates of the bottleneck over time [bit/s]; of opportunities the mean; () without one."""
        times_ns = self.profile.opportunities
        if times_ns:
            return (len(times_ns) * 8.0 * OPPORTUNITY_BYTES / (times_ns[-1] * 1e-9),)
        return tuple(piece.rate for piece in LinkSchedule(self.profile).pieces if piece.rate)

    @property
    def occupies(self) -> float:
        """Time for which a usual message occupies the bottleneck at first [s]; NaN without one."""
        return self.bits / self.rates[0] if self.rates else nan

    def exceeds_rate(self, period: float) -> bool:
        """Return whether a message per `period` [s] is more than the bottleneck has, at times."""
        return bool(self.rates) and self.bits / period > min(self.rates) * (1.0 + 1e-9)


class Lane:
    """The messages of one direction, in flight and counted.

    Attributes:
        wire: What it is made for.
        queue: The messages in flight; of a stream, those that have arrived.
        is_stream: Whether losses are repaired. Then call `run` before you look into the queue.
    """

    def __init__(
        self, wire: Wire, seed: int, stream: str, start: Callable[[int], int] | None = None
    ) -> None:
        """Send over a link with its `seed` and its name, `stream`.

        `start` returns where in the schedule of the link an episode begins [ns]; None: at 0.
        """
        self.wire, self._seed, self._name, self._start = wire, seed, stream, start
        self._way = OneWay(wire.profile, seed, wire.uplink, stream=stream, start=start)
        self._size, self._cut, self._occupies = wire.size, wire.cut, wire.occupies
        self.is_stream = wire.delivery == STREAM
        # Largest message that is a packet with its own number.
        self._plain = wire.packet_bytes if wire.is_plain else -1
        self.begin(0)

    def begin(self, episode: int) -> None:
        """Begin an episode without packets."""
        self._episode, self.queue = episode, PacketQueue()
        self._link = self._way.begin(episode)
        self._send = self._link.send_checked if self._link.corrupts else self._link.send
        self.sent = self._delays_ns = self._delivered = 0
        self._more_sent = self._more_lost = 0  # packets beyond one of each message
        if self.is_stream:
            self._agenda = PacketQueue()
            ways = self._medium(self.wire.uplink), self._medium(not self.wire.uplink)
            self._stream = MessageStream(self._agenda, ways, episode, self._cut, self._deliver)

    def _medium(self, uplink: bool) -> Medium:
        profile = self.wire.link.uplink if uplink else self.wire.link.downlink
        origin_ns = -self._start(self._episode) if self._start else 0
        name, headers = self._name, HEADER_BYTES
        return Medium(profile, self._seed, uplink, origin_ns, stream=name, headers=headers)

    def send(self, number: int, now_ns: int, message: Any, more: int = 0) -> None:
        """Send a message at `now_ns` [ns] with `more` bytes than usual, or lose it."""
        self.sent += 1
        size = self._size + more
        if size <= self._plain:  # nearly all messages: save time
            arrivals = self._send(self._episode, KIND, number, size, now_ns)
            if len(arrivals) > 1:
                arrivals = (min(arrivals),)  # of two copies
        elif self.is_stream:
            self._agenda.put(self._stream.send, (now_ns,), (number, size, (now_ns, message)))
            return
        else:
            pieces = self._cut.pieces(number, size)
            arrivals, lost = self._link.send_pieces(self._episode, pieces, now_ns)
            self._more_sent += len(pieces) - 1
            self._more_lost += lost - (not arrivals)
        if arrivals:
            self._delays_ns += arrivals[0] - now_ns
        self.queue.put(None, arrivals, message)

    def run(self, until_ns: int) -> None:
        """Let a stream send, repair and deliver all that is due by `until_ns` [ns]."""
        if self.is_stream:
            run_due(self._agenda, until_ns)

    def _deliver(self, sent: tuple[int, Any], now_ns: int) -> None:
        """Take a message of the stream."""
        sent_ns, message = sent
        self._delays_ns += now_ns - sent_ns
        self._delivered += 1
        self.queue.put(None, (now_ns,), message)

    @property
    def arrived(self) -> int:
        """Number of messages that arrive; of a stream, that have arrived."""
        return self._delivered if self.is_stream else self.sent - self.queue.lost

    def summary(self, asked: tuple[float, float]) -> dict[str, float]:
        """Return mean delay [s] and loss of messages: as `asked`, and measured in this episode."""
        lost, arrived = self.queue.lost, self.arrived
        delay, loss = asked
        packets = self.sent + self._more_sent, lost + self._more_lost
        if self.is_stream:
            packets = self._stream.transmissions, self._stream.lost
        return {
            "delay_asked": delay,
            "delay_measured": self._delays_ns * 1e-9 / arrived if arrived else nan,
            "loss_asked": loss,
            "loss_measured": lost / self.sent if self.sent else nan,
            "sent": self.sent,
            "packets_sent": packets[0],
            "packets_lost": packets[1],
            "bytes": self._size,
            "on_link": self._occupies,
        }


class WaitingLane(Lane):
    """The messages of a robot that wait until a shared channel sends them: the newest one waits.

    Attributes:
        waiting: Number of the waiting message, the message, and how many bytes it has more than
            usual; None if none waits.
    """

    def begin(self, episode: int) -> None:
        """Begin an episode without packets."""
        super().begin(episode)
        self.waiting: tuple[int, Any, int] | None = None

    def send(self, number: int, now_ns: int, message: Any, more: int = 0) -> None:
        """Let a message wait, in place of an older one."""
        self.waiting = number, message, more

    def leave(self, now_ns: int) -> None:
        """Let the waiting message leave the channel at `now_ns` [ns]."""
        assert self.waiting is not None, "the channel sends what waits"
        (number, message, more), self.waiting = self.waiting, None
        super().send(number, now_ns, message, more)
