"""Forward datagrams in real time, each delayed, lost or copied as the link's model says.

Local mode runs `Relay`, with both directions. In a pod, `RelayShaper` shapes what the pod sends:

    world <-> [world side]  Relay  [cloud side] <-> cloud
    tunnel end > [listen]  RelayShaper  [any port] > the other pod's tunnel end

A datagram is due when the kernel received it plus the delay that the model draws, however long it
waited for this process. It never leaves earlier.

The relay sleeps in `select` until a datagram arrives or shortly before one is due. Then it reads
the clock until that instant, since a sleeping thread wakes 15 to 50 us late. It releases what is
due before it takes in what has arrived, which has its stamp and can wait.

A socket is connected to its end: the kernel drops what comes from any other address, and this
process is not even woken.
"""

from __future__ import annotations

import ctypes
import gc
import heapq
import os
import select
import socket
import sys
import time
from collections import Counter
from collections.abc import Callable, Collection, Sequence
from itertools import count
from time import monotonic_ns
from typing import TypeAlias

from cloudrc.link.lateness import Recent, ReleaseErrors, in_ns
from cloudrc.link.model import LinkDirection
from cloudrc.link.profile import DirectionProfile

Address: TypeAlias = tuple[str, int]
Peek: TypeAlias = Callable[[bytes], tuple[int, int, int]]
"""Returns kind, epoch and counter of a datagram; raises ValueError if it is not one of ours."""
Send: TypeAlias = Callable[[bytes], object]
"""Sends a datagram; raises OSError if the kernel refuses."""

IN_FLIGHT_MAX = 10_000
"""Limit of datagrams that a lane holds at once [1]; more are dropped and counted."""
DATAGRAM_MAX = 2_048
"""Limit of a datagram's length [bytes], so that the memory of a lane is bounded."""
BATCH = 32
"""Limit of datagrams that a lane takes in, or releases, before the other lane's turn [1]."""
SPIN_NS = 60_000
"""Longest time for which the relay reads the clock before a datagram is due [ns]. Wakes that are
later than this have other causes than the timer, such as other programs."""
STOP_PERIOD = 0.1
"""Longest time between two calls of `stop` [s]."""

ANCILLARY_SIZE = 64
"""Size of the buffer for the kernel's stamp and its count of drops [bytes]."""
AGE_MAX_NS = 50_000_000
"""Limit of a datagram's age when it is read [ns]; an older one counts as this old."""
_STEP_MIN_NS = 1_000_000
"""Difference of two looks at the clocks above which the wall clock was set [ns]."""
_COUNT_MASK = 0xFFFF_FFFF
# Source: Linux, include/uapi/asm-generic/socket.h; Python has no names for them.
_SO_TIMESTAMPNS = 35
_SO_RXQ_OVFL = 40


def ask_for_stamps(one: socket.socket) -> bool:
    """Make the kernel stamp what arrives and count what it drops, where it can.

    Returns:
        Whether it stamps.
    """
    if sys.platform != "linux":
        return False
    granted = []
    for option in (_SO_TIMESTAMPNS, _SO_RXQ_OVFL):
        try:
            one.setsockopt(socket.SOL_SOCKET, option, 1)
            granted.append(option)
        except OSError:  # without stamps a datagram arrives when it is read
            continue
    return _SO_TIMESTAMPNS in granted


class Stamps:
    """Reads what the kernel says about the datagrams of one socket.

    The kernel stamps arrivals (SO_TIMESTAMPNS) by the wall clock, which people and NTP set. So a
    stamp is converted at once to an age, and the monotonic clock minus the age is what counts.

    Attributes:
        dropped: Number of datagrams that found the socket's buffer full, as far as it is known.
    """

    def __init__(self) -> None:
        """Start before the first datagram."""
        self.dropped = 0
        self._dropped_told = 0
        self._offset_ns: int | None = None

    def look_at_clocks(self) -> int | None:
        """Compare the clocks, before datagrams are read in one go.

        The wall clock is read first: a pause between the two readings makes a datagram later,
        never earlier.

        Returns:
            Monotonic minus wall clock [ns]; None if the wall clock was set since the last look, so
            that a stamp gives no age.
        """
        before = self._offset_ns
        wall_ns = time.time_ns()
        offset_ns = self._offset_ns = time.monotonic_ns() - wall_ns
        if before is not None and abs(offset_ns - before) > _STEP_MIN_NS:
            return None
        return offset_ns

    def wall_ns(self, ancillary: Sequence[tuple[int, int, bytes]]) -> int | None:
        """Read the kernel's stamp of a datagram and its count of drops.

        Args:
            ancillary: As `recvmsg` returns it.

        Returns:
            Arrival on the wall clock [ns]; None without a stamp.
        """
        wall_ns = None
        for _, kind, data in ancillary:
            if kind == _SO_TIMESTAMPNS:
                seconds, rest = memoryview(data).cast("l")
                wall_ns = seconds * 1_000_000_000 + rest
            elif kind == _SO_RXQ_OVFL:  # a 32-bit count
                told = int.from_bytes(data, sys.byteorder)
                self.dropped += (told - self._dropped_told) & _COUNT_MASK
                self._dropped_told = told
        return wall_ns


def instant_ns(wall_ns: int | None, offset_ns: int | None, now_ns: int) -> int:
    """Convert a stamp to the monotonic clock.

    Args:
        wall_ns: From `Stamps.wall_ns` [ns].
        offset_ns: From `Stamps.look_at_clocks` [ns].
        now_ns: Monotonic clock after the datagram was read [ns].

    Returns:
        Arrival on the monotonic clock [ns], between `AGE_MAX_NS` ago and `now_ns`.
    """
    if wall_ns is None or offset_ns is None:
        return now_ns
    return max(now_ns - AGE_MAX_NS, min(now_ns, wall_ns + offset_ns))


class Lane:
    """Takes datagrams in, asks the model, and sends them when they are due.

    Attributes:
        source: Socket at which they arrive.
        direction: Model of the link.
        origin_ns: Start of the model's time [ns], monotonic clock; None: the first datagram.
        errors: How late datagrams have left.
    """

    def __init__(
        self,
        source: socket.socket,
        send: Send,
        direction: LinkDirection,
        peek: Peek,
        in_flight_max: int = IN_FLIGHT_MAX,
    ) -> None:
        """Set up.

        Args:
            source: Bound UDP socket; the caller closes it.
            send: Sends a datagram to the other end.
            direction: Model of the link.
            peek: Reads kind, epoch and counter of a datagram.
            in_flight_max: Limit of datagrams held at once.
        """
        source.setblocking(False)
        ask_for_stamps(source)
        self.source, self.direction = source, direction
        self.origin_ns: int | None = None
        self.errors = ReleaseErrors()
        self._output, self._peek, self._in_flight_max = send, peek, in_flight_max
        # Due instant [ns], a number that keeps equal instants in order, data.
        self._in_flight: list[tuple[int, int, bytes]] = []
        self._numbers = count()
        self._stamps = Stamps()
        self._received = self._forwarded = self._lost = 0
        self._malformed = self._overflow = self._unsent = self._stalled = 0

    def due_ns(self) -> int | None:
        """Return when the next datagram is due [ns], monotonic clock; None if none is held."""
        return self._in_flight[0][0] if self._in_flight else None

    def take_in(self) -> None:
        """Put what waits in the socket on the link, at most `BATCH` datagrams."""
        offset_ns, read = self._stamps.look_at_clocks(), self._stamps.wall_ns
        for _ in range(BATCH):
            try:
                data, beside, flags, _ = self.source.recvmsg(DATAGRAM_MAX, ANCILLARY_SIZE)
            except ConnectionRefusedError:  # an earlier datagram found nobody at this end
                continue
            except OSError:  # nothing waits
                return
            self._received += 1
            now_ns = monotonic_ns()
            received_ns = instant_ns(read(beside), offset_ns, now_ns)
            self._stalled += now_ns - received_ns >= AGE_MAX_NS
            try:
                if flags & socket.MSG_TRUNC:
                    raise ValueError("too long")
                header = self._peek(data)
            except ValueError:
                self._malformed += 1
            else:
                self._put_on_link(data, *header, received_ns)

    def release(self) -> None:
        """Send what is due, at most `BATCH` datagrams."""
        for _ in range(BATCH):
            now_ns = monotonic_ns()
            if not self._in_flight or self._in_flight[0][0] > now_ns:
                return
            due_ns, _, data = heapq.heappop(self._in_flight)
            if self._send(data):
                self._forwarded += 1
                self.errors.observe(now_ns - due_ns)
            else:
                self._unsent += 1

    def counts(self) -> dict[str, int]:
        """Count datagrams by what became of them; `Lanes.outcomes` explains the names."""
        return {
            "received": self._received,
            "forwarded": self._forwarded,
            "lost": self._lost,
            "malformed": self._malformed,
            "overflow": self._overflow,
            "unread": self._stamps.dropped,
            "unsent": self._unsent,
        }

    def released(self) -> dict[str, int]:
        """Return how late datagrams left since the beginning; any thread may call this.

        Returns:
            As `lateness.in_ns`, with `overflow`, the number for which there was no room, and
            `stalled`, the number that waited for this process for `AGE_MAX_NS` or more, so that
            they may have left later than their errors say. Empty before the first datagram.
        """
        told = in_ns(self.errors)
        return {**told, "overflow": self._overflow, "stalled": self._stalled} if told else {}

    def _put_on_link(
        self, data: bytes, kind: int, epoch: int, counter: int, received_ns: int
    ) -> None:
        """Draw what becomes of a datagram, and hold it if it is not lost."""
        if self.origin_ns is None:
            self.origin_ns = received_ns
        elapsed_ns = received_ns - self.origin_ns
        releases = self.direction.send(epoch, kind, counter, len(data), elapsed_ns)
        if not releases:
            self._lost += 1
        elif self.direction.corrupts:
            data = self.direction.corrupted(epoch, kind, counter, data)
        for release_ns in releases:
            if len(self._in_flight) >= self._in_flight_max:
                self._overflow += 1
            else:
                due_ns = release_ns + self.origin_ns
                heapq.heappush(self._in_flight, (due_ns, next(self._numbers), data))

    def _send(self, data: bytes) -> bool:
        """Send one datagram; return whether the kernel took it."""
        for _ in range(2):
            try:
                self._output(data)
            except ConnectionRefusedError:  # of an earlier datagram: this one was not sent
                continue
            except OSError:
                return False
            else:
                return True
        return False


class Lanes:
    """Lanes that share one thread and one wait."""

    def __init__(self, lanes: Sequence[Lane], origin_ns: int | None) -> None:
        """Set up.

        Args:
            lanes: At least one.
            origin_ns: Start of their models' time [ns], monotonic clock; None: the first datagram
                on any lane, as in virtual time.
        """
        self._lanes = tuple(lanes)
        self._sources = [lane.source for lane in self._lanes]
        self._recent = Recent()
        self._origin_known = False
        self._set_origin(origin_ns)

    def run_for(self, timeout: float) -> None:
        """Forward for `timeout` [s], or a little longer."""
        until_ns = monotonic_ns() + round(timeout * 1e9)
        while (rest_ns := until_ns - monotonic_ns()) > 0:
            self.step(rest_ns * 1e-9)

    def step(self, timeout: float) -> None:
        """Wait for a datagram or a due instant, at most `timeout` [s], and handle both."""
        due_ns = min((due for lane in self._lanes if (due := lane.due_ns()) is not None), default=0)
        if due_ns:
            timeout = min(timeout, max(0.0, (due_ns - SPIN_NS - monotonic_ns()) * 1e-9))
        readable, _, _ = select.select(self._sources, (), (), timeout)
        if due_ns and due_ns - monotonic_ns() <= SPIN_NS:
            while monotonic_ns() < due_ns:
                pass
            self._release()
        self.take_in(readable)
        self._release()  # what has no delay

    def take_in(self, readable: Collection[socket.socket] | None = None) -> None:
        """Put on the link what waits in these sockets, by default in all.

        Call it before a direction's profile changes.
        """
        for lane in self._lanes:
            if readable is None or lane.source in readable:
                lane.take_in()
                if not self._origin_known:
                    self._set_origin(lane.origin_ns)

    def outcomes(self) -> dict[str, int]:
        """Count the datagrams of all lanes by what became of them.

        Returns:
            `received`; `lost` on the link by any cause; `malformed`; `overflow` beyond
            `in_flight_max`; `unread` because the socket's buffer was full (the kernel says so with
            the next datagram); `unsent` because the other end is unknown or the kernel refused;
            `forwarded`, copies included.
        """
        outcomes: Counter[str] = Counter()
        for lane in self._lanes:
            outcomes.update(lane.counts())
        return dict(outcomes)

    def recent(self) -> dict[str, int]:
        """Return the recent lateness, as `Recent.counts`; call it once a second."""
        return self._recent.counts(self._errors())

    def counts(self) -> dict[str, float]:
        """Return `outcomes`, and the lateness since the beginning.

        The lateness is `released_early`, and `release_error_p50`, `_p99` and `_p999` [s], which are
        absent before the first datagram.
        """
        errors = self._errors()
        return {**self.outcomes(), "released_early": errors.early, **errors.quantiles()}

    def _errors(self) -> ReleaseErrors:
        return ReleaseErrors.together(lane.errors for lane in self._lanes)

    def _release(self) -> None:
        for lane in self._lanes:
            lane.release()

    def _set_origin(self, origin_ns: int | None) -> None:
        if origin_ns is not None:
            self._origin_known = True
            for lane in self._lanes:
                lane.origin_ns = origin_ns


class Relay(Lanes):
    """Forwards datagrams between world and cloud through the two directions of a link."""

    def __init__(
        self,
        uplink: LinkDirection,
        downlink: LinkDirection,
        peek: Peek,
        *,
        world_side: socket.socket,
        cloud_side: socket.socket,
        world_peer: Address,
        cloud_peer: Address,
        in_flight_max: int = IN_FLIGHT_MAX,
    ) -> None:
        """Connect both sockets to their ends; the caller closes them.

        Args:
            uplink: World to cloud. Its time starts at the first datagram, as in virtual time,
                however long the processes take to start: leave its origin at 0.
            downlink: Cloud to world, likewise.
            peek: Reads kind, epoch and counter of a datagram.
            world_side: Bound UDP socket that world sends to.
            cloud_side: Bound UDP socket that cloud sends to.
            world_peer: Address at which world receives and from which it sends.
            cloud_peer: Likewise for cloud.
            in_flight_max: Limit of datagrams held at once in each direction.

        Raises:
            OSError: If an end cannot be reached from its socket's address.
        """
        world_side.connect(world_peer)
        cloud_side.connect(cloud_peer)
        self._ways = {
            "uplink": Lane(world_side, cloud_side.send, uplink, peek, in_flight_max),
            "downlink": Lane(cloud_side, world_side.send, downlink, peek, in_flight_max),
        }
        super().__init__(tuple(self._ways.values()), origin_ns=None)

    def run(self, stop: Callable[[], bool]) -> None:
        """Forward until `stop` returns True; it is called at least every 0.1 s."""
        tighten_slack()
        while not stop():
            self.run_for(STOP_PERIOD)

    def released(self, way: str) -> dict[str, int]:
        """Return how late datagrams of "uplink" or "downlink" left, as `Lane.released`."""
        return self._ways[way].released()


class RelayShaper:
    """One direction of the link in userspace; a `Shaper`."""

    name = "relay"

    def __init__(
        self, listen: Address, direction: LinkDirection, peek: Peek, end: Address | None = None
    ) -> None:
        """Open the two sockets.

        Args:
            listen: Where this pod's tunnel end sends to; port 0 lets the kernel choose.
            direction: The link, its origin on the machine's monotonic clock.
            peek: Reads kind, epoch and counter of a datagram.
            end: Where this pod's tunnel end sends from; the kernel drops what comes from others.
                None: any sender.

        Raises:
            OSError: If `listen` is in use, or cannot be reached from `end`.
        """
        self._inside = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        try:
            self._inside.bind(listen)
            if end is not None:
                self._inside.connect(end)
        except OSError:
            self._inside.close()
            raise
        # The kernel refuses to send from a socket bound to 127.0.0.1 to another machine.
        self._outside = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._outside.setblocking(False)
        self._peer: Address | None = None
        self._lane = Lane(self._inside, self._send, direction, peek)
        self._lanes = Lanes((self._lane,), origin_ns=0)
        tighten_slack()

    def follow_peer(self, peer: Address) -> Address:
        """Send to this peer from now on, what is in flight included."""
        self._peer = peer
        host, port = self._inside.getsockname()
        return host, port

    def follow_profile(self, profile: DirectionProfile, *, restart: bool = False) -> None:
        """Shape by this profile from now on; what is in flight keeps its delay.

        Args:
            profile: Conditions.
            restart: Whether their time line starts now; otherwise it continues.
        """
        self._lanes.take_in()  # what has arrived until now belongs to the old profile
        self._lane.direction.replace_profile(profile, restart=restart)

    def step(self, timeout: float) -> None:
        """Forward for `timeout` [s]."""
        self._lanes.run_for(timeout)

    def counts(self) -> dict[str, int]:
        """Return `Lanes.outcomes` and `Lanes.recent`."""
        return self._lanes.outcomes() | self._lanes.recent()

    def released(self) -> dict[str, int]:
        """Return how late datagrams left since the beginning, as `Lane.released`."""
        return self._lane.released()

    def close(self) -> None:
        """Close the sockets; what is in flight is lost."""
        self._inside.close()
        self._outside.close()

    def _send(self, data: bytes) -> None:
        if self._peer is None:
            raise OSError("no peer yet")
        self._outside.sendto(data, self._peer)


_FIFO_PRIORITY = 10
"""Real-time priority [1]: above ordinary processes, below the kernel's own threads (50)."""
_SWITCH_INTERVAL = 0.0002
"""Longest time for which another thread of this process keeps the interpreter [s]."""
_COLLECT_AFTER = 50_000
"""New objects between two garbage collections [1]; datagrams in flight are no garbage."""
_SET_TIMERSLACK = 29


def settle() -> None:
    """Make garbage collection rare and cheap, and turns of other threads short."""
    sys.setswitchinterval(_SWITCH_INTERVAL)
    gc.collect()
    gc.freeze()
    gc.set_threshold(_COLLECT_AFTER)


def tighten_slack() -> None:
    """Let sleeps of the calling thread end when they are due, not up to 50 us later.

    Source: PR_SET_TIMERSLACK, prctl(2); Linux only.
    """
    if sys.platform == "linux":
        ctypes.CDLL(None).prctl(_SET_TIMERSLACK, ctypes.c_ulong(1), 0, 0, 0)


def ask_for_fifo() -> str:
    """Give the calling thread SCHED_FIFO, if it is permitted; children do not inherit it.

    Returns:
        "" if granted, else the reason.
    """
    if not hasattr(os, "SCHED_FIFO"):
        return "this system has no SCHED_FIFO"
    try:
        policy = os.SCHED_FIFO | os.SCHED_RESET_ON_FORK
        os.sched_setscheduler(0, policy, os.sched_param(_FIFO_PRIORITY))
    except OSError as error:
        return f"{error.strerror}; it takes CAP_SYS_NICE or a limit on rtprio"
    return ""
