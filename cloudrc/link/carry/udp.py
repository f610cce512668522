# SPDX-License-Identifier: Apache-2.0

"""Forward datagrams in real time, and delay, lose or copy each one as the link's model computes.

A relay shapes one direction of the link:

    world or cloud > [listen]  Relay  [any port] > cloud or world

A datagram is due at its time of arrival at the kernel plus the delay from the model.
"""

from __future__ import annotations

import select
import socket
import sys
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from time import monotonic_ns, time_ns

from cloudrc.base.files import at_place
from cloudrc.link.carry.engine import BATCH, Engine, LinkWay, Packet
from cloudrc.link.carry.log import PacketLog, ReleaseErrors
from cloudrc.link.model import LinkDirection
from cloudrc.link.profile import DirectionProfile

Address = tuple[str, int]
Peek = Callable[[bytes], tuple[int, int, int]]
"""Function that returns kind, epoch and counter of a datagram, or raises a ValueError."""

IN_FLIGHT_MAX = 10_000  # datagrams in flight in one direction; more are dropped and counted
DATAGRAM_MAX = 2_048  # largest length of a datagram, to limit the memory in use [bytes]
ANCILLARY_SIZE = 64  # buffer for the kernel's time stamp and count of dropped datagrams [bytes]
AGE_MAX_NS = 50_000_000  # largest time from arrival to reading that the relay compensates [ns]

_RECENT = 10  # number of calls of `Relay.counts` over which its percentiles are computed
# Source: Linux, include/uapi/asm-generic/socket.h; Python has no names for them.
_SO_TIMESTAMPNS, _SO_RXQ_OVFL = 35, 40


def ask_for_stamps(one: socket.socket) -> None:
    """Ask the kernel for the arrival times and the number of dropped datagrams of a socket."""
    for option in (_SO_RXQ_OVFL, _SO_TIMESTAMPNS) if sys.platform == "linux" else ():
        with suppress(OSError):  # without a stamp, the time of reading counts as arrival
            one.setsockopt(socket.SOL_SOCKET, option, 1)


class Stamps:
    """Reads the kernel's arrival times and counts of dropped datagrams for one socket.

    Attributes:
        dropped: Number of datagrams dropped because the socket's buffer was full.
    """

    def __init__(self) -> None:
        self.dropped = 0

    def wall_ns(self, ancillary: Sequence[tuple[int, int, bytes]]) -> int | None:
        """Return when a datagram arrived, wall clock [ns]; None if the kernel gave no time stamp.

        `ancillary` is the ancillary data from `recvmsg`. The method also updates `dropped`.
        """
        wall_ns = None
        for _, kind, data in ancillary:
            if kind == _SO_TIMESTAMPNS:
                seconds, rest = memoryview(data).cast("l")
                wall_ns = seconds * 1_000_000_000 + rest
            elif kind == _SO_RXQ_OVFL:  # a 32-bit count
                told = int.from_bytes(data, sys.byteorder)
                self.dropped += (told - self.dropped) & 0xFFFF_FFFF
        return wall_ns

    def age_ns(self, ancillary: Sequence[tuple[int, int, bytes]], now_ns: int) -> int:
        """Return the time since a datagram arrived [ns]; 0 if the kernel gave no time stamp.

        `now_ns` is the wall clock [ns]. The result is limited to 0 ... AGE_MAX_NS, because it is
        wrong if a user or NTP has just set the wall clock.
        """
        wall_ns = self.wall_ns(ancillary)
        return 0 if wall_ns is None else min(max(0, now_ns - wall_ns), AGE_MAX_NS)


class Entrance:
    """A socket at which the datagrams of a direction enter.

    Attributes:
        stamps: Arrival times and dropped datagrams of the socket.
        malformed: Number of datagrams that are not from the tunnel.
        stalled: Number of datagrams that waited `AGE_MAX_NS` or longer to be read.
    """

    def __init__(self, one: socket.socket, way: LinkWay, peek: Peek) -> None:
        """Take in at a bound socket; `peek` reads kind, epoch and counter of a datagram."""
        one.setblocking(False)
        ask_for_stamps(one)
        # Room for the datagrams that arrive while this process stands still.
        one.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 1 << 22)
        self._socket, self._way, self._peek = one, way, peek
        self.stamps, self.malformed, self.stalled = Stamps(), 0, 0

    def take(self) -> Iterator[Packet]:
        """Read up to `BATCH` datagrams; skip those that are not from the tunnel."""
        for _ in range(BATCH):
            try:
                data, beside, flags, _ = self._socket.recvmsg(DATAGRAM_MAX, ANCILLARY_SIZE)
            except OSError:  # no datagram waits
                return
            age_ns = self.stamps.age_ns(beside, time_ns())
            # Read the wall clock first: then a pause between the readings makes no datagram early.
            received_ns = monotonic_ns() - age_ns
            self.stalled += age_ns >= AGE_MAX_NS
            try:
                if flags & socket.MSG_TRUNC:
                    raise ValueError("too long")
                header = self._peek(data)
            except ValueError:
                self.malformed += 1
            else:
                yield Packet(self._way, header, len(data), data, received_ns)


class Exit:
    """A socket from which datagrams leave to a peer, whose address may change."""

    def __init__(self, one: socket.socket) -> None:
        """Send from a socket; the peer is unknown."""
        self._socket = one
        self.peer: Address | None = None

    def __call__(self, data: bytes) -> bool:
        """Send a datagram to the peer; return whether it is known and the kernel agrees."""
        if self.peer is None:
            return False
        try:
            self._socket.sendto(data, self.peer)
        except OSError:
            return False
        return True


class Relay:
    """Shapes one direction of the link without the kernel's netem; same methods as `Netem`."""

    name = "relay"

    def __init__(
        self, listen: Address, direction: LinkDirection, peek: Peek, end: Address | None = None
    ) -> None:
        """Open the sockets; raise an OSError if `listen` is in use or cannot reach `end`.

        World or cloud sends from the address `end` (None: from any address) to the address `listen`
        (port 0: any free port). The times of the model `direction` are on the monotonic clock.
        `peek` reads kind, epoch and counter of a datagram.
        """
        self._inside = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        # The kernel does not send from a socket bound to 127.0.0.1 to another machine.
        self._outside = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        try:
            self._inside.bind(listen)
            if end is not None:
                with at_place(f"--end {end[0]}"):
                    self._inside.connect(end)
        except OSError:
            self.close()
            raise
        self._outside.setblocking(False)
        self._exit = Exit(self._outside)
        self._way = LinkWay(direction, self._exit, PacketLog(0))
        self._entrance = Entrance(self._inside, self._way, peek)
        self.take = self._entrance.take
        self._engine = Engine(self, (self._way,), IN_FLIGHT_MAX)
        self._past: deque[ReleaseErrors] = deque([ReleaseErrors()], maxlen=_RECENT)

    def follow_peer(self, peer: Address) -> Address:
        """Send all datagrams to this peer from now on, including those in flight.

        Returns:
            The relay's own address, to which the sending end of the tunnel has to send.
        """
        self._exit.peer = peer
        host, port = self._inside.getsockname()
        return host, port

    def follow_profile(
        self, profile: DirectionProfile, *, restart: bool = False, start_ns: int = 0
    ) -> None:
        """Use this profile from now on; with `restart`, its schedule starts at the next packet."""
        self._engine.take_in()  # datagrams that have arrived belong to the old profile
        self._way.link.replace_profile(profile, restart=restart, start_ns=start_ns)

    def step(self, timeout: float) -> None:
        """Forward datagrams for `timeout` [s] or slightly longer."""
        until_ns = monotonic_ns() + round(timeout * 1e9)
        while (rest_ns := until_ns - monotonic_ns()) > 0:
            self._engine.step(rest_ns * 1e-9)

    def counts(self) -> dict[str, int]:
        """Return the number of datagrams by outcome, and percentiles of their lateness [ns].

        The outcomes are `received`; `forwarded` (including copies); `lost` on the link; `malformed`
        (not from the tunnel); `overflow` (too many in flight, see `IN_FLIGHT_MAX`); `unread` (the
        socket's buffer was full); `unsent` (the receiver is unknown or the kernel failed).

        If this method is called once a second, the percentiles cover the last 10 s.
        `released_early` is the number of datagrams since the start that left before they were due.
        """
        errors = ReleaseErrors(self._engine.errors)
        recent = ReleaseErrors(errors - self._past[0]).in_ns()
        self._past.append(errors)
        recent.pop("released", None)
        outcomes = self._engine.counts()
        malformed, unread = self._entrance.malformed, self._entrance.stamps.dropped
        outcomes["received"] += malformed
        outcomes |= {"malformed": malformed, "unread": unread}
        return {**outcomes, **recent, "released_early": errors.early}

    def released(self) -> dict[str, int]:
        """Return how many datagrams left and how late; any thread may call this method.

        Returns:
            The number of datagrams that left (`released`), that left too early (`released_early`),
            that were dropped because too many were in flight (`overflow`), and that waited
            `AGE_MAX_NS` or longer to be read (`stalled`); and percentiles of the lateness, such as
            `release_error_p99_ns` [ns]. Empty before the first datagram leaves.
        """
        more = {"overflow": self._engine.queue.overflow, "stalled": self._entrance.stalled}
        return told | more if (told := self._engine.errors.in_ns()) else {}

    def close(self) -> None:
        """Close the sockets; datagrams in flight are lost."""
        self._inside.close()
        self._outside.close()

    def wait(self, until_ns: int) -> bool:
        """Wait until datagrams have come, or until a time [ns]; return whether some have come."""
        timeout = max(0.0, (until_ns - monotonic_ns()) * 1e-9)
        return bool(select.select([self._inside], (), (), timeout)[0])
