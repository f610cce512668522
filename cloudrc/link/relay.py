"""Forward datagrams in real time, and delay, lose or copy each one as the link's model computes.

A relay shapes one direction of the link:

    world or cloud > [listen]  Relay  [any port] > cloud or world

A datagram is due at its time of arrival at the kernel plus the delay from the model. The relay
never sends a datagram before it is due. A sleeping thread wakes 15 to 50 us late; so the relay
sleeps until shortly before the next datagram is due, and then reads the clock in a loop.
"""

from __future__ import annotations

import ctypes
import gc
import os
import select
import socket
import sys
from collections import Counter, deque
from collections.abc import Callable, Sequence
from contextlib import suppress
from time import monotonic_ns, time_ns
from typing import TypeAlias

from cloudrc.link.model import LinkDirection
from cloudrc.link.profile import DirectionProfile
from cloudrc.link.queue import PacketQueue

Address: TypeAlias = tuple[str, int]
Peek: TypeAlias = Callable[[bytes], tuple[int, int, int]]
"""Function that returns kind, epoch and counter of a datagram, or raises a ValueError."""

IN_FLIGHT_MAX = 10_000  # datagrams in flight in one direction; more are dropped and counted
DATAGRAM_MAX = 2_048  # largest length of a datagram, to limit the memory in use [bytes]
BATCH = 32  # datagrams that a relay reads before it sends, and sends before it reads again
SPIN_NS = 60_000  # the relay reads the clock in a loop for this time before a datagram is due [ns]
ANCILLARY_SIZE = 64  # buffer for the kernel's time stamp and count of dropped datagrams [bytes]
AGE_MAX_NS = 50_000_000  # largest time from arrival to reading that the relay compensates [ns]
QUANTILES = {"p50": 0.5, "p99": 0.99, "p999": 0.999}  # name -> quantile of the lateness, in [0, 1]

_BITS = 7  # number of significant bits of a lateness that select its bucket: buckets are 1.6 % wide
_EARLY = -1  # bucket of the datagrams that left before they were due
_RECENT = 10  # number of calls of `Relay.counts` over which its percentiles are computed
_FIFO_PRIORITY = 10  # above ordinary processes, below the kernel's threads (50)
_SWITCH_INTERVAL = 0.0002  # longest time for which another thread can block the relay's thread [s]
_COLLECT_AFTER = 50_000  # new objects before a garbage collection; most are datagrams in flight
# Source: Linux, include/uapi/asm-generic/socket.h, prctl.h; Python has no names for them.
_SO_TIMESTAMPNS, _SO_RXQ_OVFL, _SET_TIMERSLACK = 35, 40, 29


class ReleaseErrors(Counter[int]):
    """Histogram of the lateness of datagrams: bucket (a range of lateness) -> count."""

    def observe(self, error_ns: int) -> None:
        """Count one datagram that left `error_ns` [ns] after it was due."""
        shift = max(0, error_ns.bit_length() - _BITS)
        self[_EARLY if error_ns < 0 else (shift << _BITS) + (error_ns >> shift)] += 1

    def in_ns(self) -> dict[str, int]:
        """Return counts and percentiles of the lateness; another thread may count meanwhile.

        Returns:
            `released`, the number of datagrams; `released_early`, those that left before they were
            due, which is a fault; and the percentiles `release_error_p50_ns`, `_p99_ns` and
            `_p999_ns` [ns]. The dictionary is empty before the first datagram.
        """
        counts, below = sorted(self.copy().items()), 0
        whole = sum(number for _, number in counts)
        wanted = [(f"release_error_{name}_ns", share) for name, share in QUANTILES.items()]
        found = {"released": whole, "released_early": self[_EARLY]} if whole else {}
        for bucket, number in counts:
            below += number
            shift, start = divmod(max(bucket, 0), 1 << _BITS)
            while wanted and below >= wanted[0][1] * whole:
                found[wanted.pop(0)[0]] = (start + 1) << shift
        return found


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
        # The kernel refuses to send from a socket bound to 127.0.0.1 to another machine.
        self._outside = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        try:
            self._inside.bind(listen)
            if end is not None:
                try:
                    self._inside.connect(end)
                except OSError as error:
                    error.strerror = f"it does not reach --end {end[0]} ({error.strerror})"
                    raise
        except OSError:
            self.close()
            raise
        for one in (self._inside, self._outside):
            one.setblocking(False)
        ask_for_stamps(self._inside)
        # Room for the datagrams that arrive while this process stands still.
        self._inside.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 1 << 22)
        self._peer: Address | None = None
        self._direction, self._peek = direction, peek
        self._in_flight = PacketQueue(IN_FLIGHT_MAX)
        self._stamps, self._stalled = Stamps(), 0
        outcomes = ("received", "forwarded", "malformed", "unsent")
        self._counts = dict.fromkeys(outcomes, 0)
        self._errors = ReleaseErrors()
        self._past: deque[ReleaseErrors] = deque([ReleaseErrors()], maxlen=_RECENT)
        tighten_slack()

    def follow_peer(self, peer: Address) -> Address:
        """Send all datagrams to this peer from now on, including those in flight.

        Returns:
            The relay's own address, to which the sending end of the tunnel has to send.
        """
        self._peer = peer
        host, port = self._inside.getsockname()
        return host, port

    def follow_profile(self, profile: DirectionProfile, *, restart: bool = False) -> None:
        """Use this profile from now on; with `restart`, its time line starts at the next packet."""
        self._take_in()  # datagrams that have arrived belong to the old profile
        self._direction.replace_profile(profile, restart=restart)

    def step(self, timeout: float) -> None:
        """Forward datagrams for `timeout` [s] or slightly longer."""
        until_ns = monotonic_ns() + round(timeout * 1e9)
        while (rest_ns := until_ns - monotonic_ns()) > 0:
            self._step_once(rest_ns * 1e-9)

    def counts(self) -> dict[str, int]:
        """Return the number of datagrams by outcome, and percentiles of their lateness [ns].

        The outcomes are `received`; `forwarded` (including copies); `lost` on the link; `malformed`
        (not from the tunnel); `overflow` (too many in flight, see `IN_FLIGHT_MAX`); `unread` (the
        socket's buffer was full); `unsent` (the receiver is unknown or the kernel refused).

        If this method is called once a second, the percentiles cover the last 10 s.
        `released_early` is the number of datagrams since the start that left before they were due.
        """
        errors = ReleaseErrors(self._errors)
        recent = ReleaseErrors(errors - self._past[0]).in_ns()
        self._past.append(errors)
        recent.pop("released", None)
        outcomes = {
            **self._counts,
            "lost": self._in_flight.lost,
            "overflow": self._in_flight.overflow,
            "unread": self._stamps.dropped,
        }
        return {**outcomes, **recent, "released_early": errors[_EARLY]}

    def released(self) -> dict[str, int]:
        """Return how many datagrams left and how late; any thread may call this method.

        Returns:
            The number of datagrams that left (`released`), that left too early (`released_early`),
            that were dropped because too many were in flight (`overflow`), and that waited
            `AGE_MAX_NS` or longer to be read (`stalled`); and percentiles of the lateness, such as
            `release_error_p99_ns` [ns]. Empty before the first datagram leaves.
        """
        more = {"overflow": self._in_flight.overflow, "stalled": self._stalled}
        return told | more if (told := self._errors.in_ns()) else {}

    def close(self) -> None:
        """Close the sockets; datagrams in flight are lost."""
        self._inside.close()
        self._outside.close()

    def _step_once(self, timeout: float) -> None:
        """Wait at most `timeout` [s] until datagrams arrive or are due; read and send them."""
        due_ns = self._in_flight.next_ns
        timeout = min(timeout, max(0.0, (due_ns - SPIN_NS - monotonic_ns()) * 1e-9))
        readable, _, _ = select.select([self._inside], (), (), timeout)
        if due_ns - monotonic_ns() <= SPIN_NS:
            while monotonic_ns() < due_ns:
                pass
            self._release()  # before reading: new datagrams have a time stamp and can wait
        if readable:
            self._take_in()
            self._release()  # datagrams without delay

    def _take_in(self) -> None:
        """Read up to `BATCH` datagrams from the socket, and compute when each is due."""
        for _ in range(BATCH):
            try:
                data, beside, flags, _ = self._inside.recvmsg(DATAGRAM_MAX, ANCILLARY_SIZE)
            except OSError:  # no datagram waits
                return
            self._counts["received"] += 1
            age_ns = self._stamps.age_ns(beside, time_ns())
            # Read the wall clock first: then a pause between the readings makes no datagram early.
            received_ns = monotonic_ns() - age_ns
            self._stalled += age_ns >= AGE_MAX_NS
            try:
                if flags & socket.MSG_TRUNC:
                    raise ValueError("too long")
                header = self._peek(data)
            except ValueError:
                self._counts["malformed"] += 1
            else:
                self._in_flight.send(self._direction, header, len(data), data, received_ns)

    def _release(self) -> None:
        """Send up to `BATCH` datagrams that are due."""
        for _ in range(BATCH):
            now_ns = monotonic_ns()
            if self._in_flight.next_ns > now_ns:
                return
            due_ns, _, data = self._in_flight.pop()
            try:
                if self._peer is None:
                    raise OSError("no peer yet")
                self._outside.sendto(data, self._peer)
            except OSError:
                self._counts["unsent"] += 1
            else:
                self._counts["forwarded"] += 1
                self._errors.observe(now_ns - due_ns)


def settle() -> None:
    """Make this process wake up in time: collect garbage rarely, and switch threads sooner."""
    sys.setswitchinterval(_SWITCH_INTERVAL)
    gc.collect()
    gc.freeze()
    gc.set_threshold(_COLLECT_AFTER)


def tighten_slack() -> None:
    """Let the calling thread wake on time after a sleep, not up to 50 us late (Linux only)."""
    if sys.platform == "linux":
        ctypes.CDLL(None).prctl(_SET_TIMERSLACK, ctypes.c_ulong(1), 0, 0, 0)


def ask_for_fifo() -> bool:
    """Give the calling thread, not its child processes, the real-time class SCHED_FIFO.

    Return whether this is permitted: it takes CAP_SYS_NICE or a limit on rtprio.
    """
    with suppress(AttributeError, OSError):  # a system without SCHED_FIFO; no permission
        policy = os.SCHED_FIFO | os.SCHED_RESET_ON_FORK
        os.sched_setscheduler(0, policy, os.sched_param(_FIFO_PRIORITY))
        return True
    return False
