"""Many datagrams with one call of the kernel, for a relay with much to do: recvmmsg and sendmmsg.

Python has neither. A datagram then costs 1 us less each way, which matters from some ten thousand a
second on; a relay that has less to do need not know of it. Linux on 64-bit machines only.
"""

from __future__ import annotations

import ctypes
import socket
import struct
import sys
from collections.abc import Sequence
from typing import Any, TypeAlias

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
