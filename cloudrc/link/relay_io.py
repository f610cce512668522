"""Many datagrams with one call of the kernel, for a relay with much to do: recvmmsg and sendmmsg.

Python has neither. A datagram then costs 1 us less each way, which matters from some ten thousand a
second on; a relay that has less to do need not know of it. Linux on 64-bit machines only.

How a relay sleeps: until a datagram waits in a socket or an instant is near, whichever is first.

`TimerWait` (Linux) lets epoll watch the sockets and a timerfd, which fires to the microsecond where
epoll's own timeout is rounded up to 1 ms. `SelectWait` does without: select's timeout is exact to
the kernel's timer slack, which `tighten_slack` takes away.

When a datagram came: the kernel's stamps go in, instants of the monotonic clock come out.

The kernel stamps a datagram as it arrives (SO_TIMESTAMPNS), however long it then waits in the
socket, but by the wall clock, which people and NTP set. So a stamp is turned into an age at once,
and what counts is the monotonic clock minus that age.
"""

from __future__ import annotations

import ctypes
import os
import select
import socket
import struct
import sys
import time
from collections.abc import Callable, Collection, Sequence
from typing import Any, Protocol, TypeAlias

Address: TypeAlias = tuple[str, int]

_SECOND_NS = 1_000_000_000
_HEADER_SIZE = 64
_ADDRESS_SIZE = 16
_CONTROL_SIZE = 64
_STAMP_SIZE = 32
"""Of the kernel's stamp with its own header [bytes]; what it dropped comes after it."""
# Plain numbers: those of `socket` are enumerations, which are slow to combine.
_TOO_LONG, _AT_ONCE = int(socket.MSG_TRUNC), int(socket.MSG_DONTWAIT)
# Length of what the kernel says beside, flags, length of the payload.
_read_headers = struct.Struct("@40xQi4xI4x").iter_unpack
# The stamp's seconds and nanoseconds, what was dropped.
_read_controls = struct.Struct("@16x2l16xI12x").iter_unpack

Received: TypeAlias = tuple[bytes | None, int | None, int | None]


class _Part(ctypes.Structure):
    """`struct iovec`."""

    _fields_ = (("base", ctypes.c_void_p), ("length", ctypes.c_size_t))


class _Header(ctypes.Structure):
    """`struct mmsghdr`."""

    _fields_ = (
        ("name", ctypes.c_void_p),
        ("name_length", ctypes.c_uint),
        ("parts", ctypes.c_void_p),
        ("parts_count", ctypes.c_size_t),
        ("control", ctypes.c_void_p),
        ("control_length", ctypes.c_size_t),
        ("flags", ctypes.c_int),
        ("length", ctypes.c_uint),
        ("_padding", ctypes.c_uint),
    )


def available() -> bool:
    """Say whether this machine can."""
    fits = ctypes.sizeof(ctypes.c_void_p) == 8 and sys.byteorder == "little"
    return sys.platform == "linux" and fits


class _Batch:
    """Room for datagrams, and what tells the kernel where it is."""

    def __init__(self, own: socket.socket, count: int, size: int, address: int | None) -> None:
        self._name, self._count, self._size = own.fileno(), count, size
        # A slice of it is a new bytes object, at half the cost of one through a memoryview.
        self._room: Any = ctypes.create_string_buffer(count * size)
        self._control = ctypes.create_string_buffer(count * _CONTROL_SIZE)
        self._parts = (_Part * count)()
        self._headers = (_Header * count)()
        for n, (part, header) in enumerate(zip(self._parts, self._headers, strict=True)):
            part.base = ctypes.addressof(self._room) + n * size
            part.length = size
            header.parts = ctypes.addressof(self._parts) + n * ctypes.sizeof(_Part)
            header.parts_count = 1
            if address is None:
                header.control = ctypes.addressof(self._control) + n * _CONTROL_SIZE
                header.control_length = _CONTROL_SIZE
            else:
                header.name, header.name_length = address, _ADDRESS_SIZE
        self._bytes = memoryview(self._room).cast("B")
        self._raw = memoryview(self._headers).cast("B")
        self._controls = memoryview(self._control).cast("B")
        # It keeps the interpreter's lock: neither call waits, and to give it away costs more.
        self._library = ctypes.PyDLL(None)


class Receiver(_Batch):
    """Reads what waits in a socket."""

    def __init__(self, own: socket.socket, count: int, size: int) -> None:
        """Make room for `count` datagrams of at most `size` bytes."""
        super().__init__(own, count, size, None)
        self._fresh = bytes(self._raw)
        self._receive = self._library.recvmmsg

    def receive(self) -> list[Received]:
        """Read as many as wait and have room; never waits.

        Returns:
            For each: its payload, or None if it was too long; the kernel's stamp of its arrival
            [ns], wall clock, or None; and how many the kernel had no room for so far, modulo 2^32,
            or None if it does not say.
        """
        headers, room, start = self._raw, self._room, 0
        headers[:] = self._fresh
        count = self._receive(self._name, self._headers, self._count, _AT_ONCE, None)
        if count <= 0:
            return []
        found: list[Received] = []
        told = _read_headers(headers[: count * _HEADER_SIZE])
        beside = _read_controls(self._controls[: count * _CONTROL_SIZE])
        for (control, flags, length), (seconds, rest, dropped) in zip(told, beside, strict=True):
            data = None if flags & _TOO_LONG else room[start : start + length]
            wall_ns = seconds * _SECOND_NS + rest if control >= _STAMP_SIZE else None
            found.append((data, wall_ns, dropped if control > _STAMP_SIZE else None))
            start += self._size
        return found


class Sender(_Batch):
    """Sends datagrams to one address."""

    def __init__(self, own: socket.socket, count: int, size: int) -> None:
        """Make room for `count` datagrams of at most `size` bytes."""
        self._address = ctypes.create_string_buffer(_ADDRESS_SIZE)
        super().__init__(own, count, size, ctypes.addressof(self._address))
        self._lengths = memoryview(self._parts).cast("B").cast("Q")
        self._peer: Address | None = None
        self._send = self._library.sendmmsg

    def send(self, datagrams: Sequence[bytes], peer: Address) -> int:
        """Send at most as many as there is room for.

        Args:
            datagrams: In this order.
            peer: To whom: an IPv4 address in numbers.

        Returns:
            How many have left; the next one was refused, if there is one.
        """
        if peer != self._peer:
            try:
                host = socket.inet_aton(peer[0])
            except OSError:
                return 0
            family = int(socket.AF_INET).to_bytes(2, sys.byteorder)
            self._address.raw = family + peer[1].to_bytes(2, "big") + host + bytes(8)
            self._peer = peer
        room, lengths, start = self._bytes, self._lengths, 0
        for n, data in enumerate(datagrams):
            length = len(data)
            room[start : start + length] = data
            lengths[2 * n + 1] = length
            start += self._size
        sent: int = self._send(self._name, self._headers, len(datagrams), 0)
        return max(0, sent)


_CLOCK_MONOTONIC = 1
_TIMER_ABSTIME = 1
_TIMER_FLAGS = os.O_NONBLOCK | getattr(os, "O_CLOEXEC", 0)
_SET_TIMERSLACK = 29


class Wait(Protocol):
    """Sleeps until there is something to do."""

    def until(self, due_ns: int | None, timeout: float) -> Collection[int]:
        """Sleep until a socket can be read, until an instant, or for a time, whichever is first.

        Args:
            due_ns: The instant [ns], monotonic clock; one that has passed only looks at the
                sockets; None if there is none.
            timeout: Longest sleep [s].

        Returns:
            Descriptors of the sockets that can be read.
        """
        ...

    def close(self) -> None:
        """Give back what the kernel lent."""
        ...


def best_wait(sockets: Sequence[socket.socket]) -> Wait:
    """Take the more exact of the two that this machine has."""
    try:
        return TimerWait(sockets)
    except (AttributeError, OSError):  # not Linux, or no descriptors left
        return SelectWait(sockets)


def tighten_slack() -> None:
    """Let timeouts of the calling thread end when they are due, not up to 50 us later.

    Source: PR_SET_TIMERSLACK, prctl(2). Where there is no such call nothing happens.
    """
    if sys.platform == "linux":
        ctypes.CDLL(None).prctl(_SET_TIMERSLACK, ctypes.c_ulong(1), 0, 0, 0)


class SelectWait:
    """Sleeps in select."""

    def __init__(self, sockets: Sequence[socket.socket]) -> None:
        """Watch these sockets, which stay their owner's."""
        self._sockets = list(sockets)

    def until(self, due_ns: int | None, timeout: float) -> Collection[int]:
        """Sleep, at most `timeout` [s]; see `Wait`."""
        if due_ns is not None:
            timeout = min(timeout, max(0.0, (due_ns - time.monotonic_ns()) * 1e-9))
        readable, _, _ = select.select(self._sockets, (), (), timeout)
        return [one.fileno() for one in readable]

    def close(self) -> None:
        """See `Wait`."""


class TimerWait:
    """Sleeps in epoll beside a timerfd; Linux only."""

    def __init__(self, sockets: Sequence[socket.socket]) -> None:
        """Watch these sockets, which stay their owner's.

        Raises:
            AttributeError: If this system has no epoll or no timerfd.
            OSError: If the kernel gives none.
        """
        self._poll = select.epoll()
        self._timer, self._arm = _timer()
        self._armed_ns = -1
        self._names = {one.fileno() for one in sockets}
        for name in self._names:
            self._poll.register(name, select.EPOLLIN)
        # Edge-triggered: one that has fired need not be read, only armed again.
        self._poll.register(self._timer, select.EPOLLIN | select.EPOLLET)

    def until(self, due_ns: int | None, timeout: float) -> Collection[int]:
        """Sleep, at most `timeout` [s]; see `Wait`."""
        if due_ns is not None:
            if due_ns <= time.monotonic_ns():
                timeout = 0.0
            elif due_ns != self._armed_ns:
                self._arm(due_ns)
                self._armed_ns = due_ns
        return [name for name, _ in self._poll.poll(timeout) if name in self._names]

    def close(self) -> None:
        """See `Wait`."""
        self._poll.close()
        os.close(self._timer)


if sys.version_info >= (3, 13):

    def _timer() -> tuple[int, Callable[[int], object]]:
        """Make a timerfd, and what arms it for an instant [ns]."""
        timer = os.timerfd_create(time.CLOCK_MONOTONIC, flags=_TIMER_FLAGS)

        def arm(due_ns: int) -> object:
            return os.timerfd_settime_ns(timer, flags=os.TFD_TIMER_ABSTIME, initial=due_ns)

        return timer, arm

else:

    class _TimerSetting(ctypes.Structure):
        """`struct itimerspec` of the C library: period, then first instant."""

        _fields_ = (
            ("period_s", ctypes.c_long),
            ("period_ns", ctypes.c_long),
            ("first_s", ctypes.c_long),
            ("first_ns", ctypes.c_long),
        )

    def _timer() -> tuple[int, Callable[[int], object]]:
        """Make a timerfd, and what arms it for an instant [ns]."""
        library = ctypes.CDLL(None, use_errno=True)
        timer = library.timerfd_create(_CLOCK_MONOTONIC, _TIMER_FLAGS)
        if timer < 0:
            raise OSError(ctypes.get_errno(), "no timerfd")
        setting = _TimerSetting()
        where, set_time = ctypes.byref(setting), library.timerfd_settime

        def arm(due_ns: int) -> object:
            setting.first_s, setting.first_ns = divmod(due_ns, _SECOND_NS)
            return set_time(timer, _TIMER_ABSTIME, where, None)

        return timer, arm


Ancillary: TypeAlias = Sequence[tuple[int, int, bytes]]

# Source: Linux, include/uapi/asm-generic/socket.h; Python has no names for them.
_SO_TIMESTAMPNS = 35
_SO_RXQ_OVFL = 40

ANCILLARY_SIZE = 64
"""Room for both of what the kernel says about a datagram [bytes]."""
AGE_MAX_NS = 50_000_000
"""A datagram that has waited longer than this is taken to have waited so long [ns]."""
_STEP_MIN_NS = 1_000_000
"""The two clocks do not drift apart by as much between two wakes: the wall clock was set [ns]."""
_COUNT_MASK = 0xFFFF_FFFF
_read_time = struct.Struct("@ll").unpack


def ask_for_stamps(one: socket.socket) -> bool:
    """Let the kernel stamp what arrives, and say what it had no room for, if it can.

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
        except OSError:  # Without stamps a datagram comes when it is read.
            continue
    return _SO_TIMESTAMPNS in granted


class Stamps:
    """Reads what the kernel says about the datagrams of one socket.

    Attributes:
        dropped: Datagrams that the kernel had no room for in the socket, as far as it has told.
    """

    def __init__(self) -> None:
        """Begin before the first datagram."""
        self.dropped = 0
        self._dropped_told = 0
        self._offset_ns: int | None = None

    def look_at_clocks(self) -> int | None:
        """Compare the clocks, before datagrams are read in one go.

        The wall clock is read first: what happens between the two readings makes ages smaller,
        and a datagram later, never earlier.

        Returns:
            Monotonic minus wall clock [ns]; None if the wall clock was set since the last time, so
            that a stamp says nothing about an age.
        """
        before = self._offset_ns
        wall_ns = time.time_ns()
        offset_ns = self._offset_ns = time.monotonic_ns() - wall_ns
        if before is not None and abs(offset_ns - before) > _STEP_MIN_NS:
            return None
        return offset_ns

    def wall_ns(self, ancillary: Ancillary) -> int | None:
        """Read the kernel's stamp beside a datagram, and how many it had no room for.

        Args:
            ancillary: What `recvmsg` gave beside it.

        Returns:
            When it arrived [ns], wall clock; None if there is no stamp.
        """
        wall_ns = None
        for _, kind, data in ancillary:
            if kind == _SO_TIMESTAMPNS:
                seconds, rest = _read_time(data)
                wall_ns = seconds * _SECOND_NS + rest
            elif kind == _SO_RXQ_OVFL:
                self.learn_dropped(int.from_bytes(data, sys.byteorder))
        return wall_ns

    def learn_dropped(self, told: int) -> None:
        """Take over the kernel's count, which begins anew after 2^32."""
        self.dropped += (told - self._dropped_told) & _COUNT_MASK
        self._dropped_told = told


def instant_ns(wall_ns: int | None, offset_ns: int | None, now_ns: int) -> int:
    """Say when a datagram came.

    Args:
        wall_ns: From `Stamps.wall_ns` [ns].
        offset_ns: From `Stamps.look_at_clocks` [ns].
        now_ns: Monotonic clock, after it was read [ns].

    Returns:
        The instant on the monotonic clock [ns], between 50 ms ago and `now_ns`.
    """
    if wall_ns is None or offset_ns is None:
        return now_ns
    received_ns = wall_ns + offset_ns
    # Comparisons, not min and max: this is asked for every datagram.
    if received_ns > now_ns:
        return now_ns
    oldest_ns = now_ns - AGE_MAX_NS
    return received_ns if received_ns > oldest_ns else oldest_ns
