"""A flow of numbered datagrams through a relay, stamped by the kernel where it leaves and arrives.

Both stamps are of the wall clock, taken by the kernel in the call that sends and in the one that
delivers: how late Python is woken does not matter.
"""

from __future__ import annotations

import socket
import sys
import time
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import TypeAlias

from cloudrc.tunnel.codec import Kind, encode_header

Address: TypeAlias = tuple[str, int]

SIZE = 172
"""About what telemetry has on the wire [bytes]."""
EPOCH = 1

# Source: Linux, include/uapi/asm-generic/socket.h, linux/net_tstamp.h, linux/errqueue.h.
_SO_TIMESTAMPNS = 35
_SO_TIMESTAMPING = 37
_TX_SOFTWARE, _SOFTWARE, _ID, _STAMP_ONLY = 1 << 1, 1 << 4, 1 << 7, 1 << 11
_IP_RECVERR = 11
_SECOND_NS = 1_000_000_000
_BUFFER = 4 << 20


@dataclass
class Flow:
    """What was sent and what arrived, in one direction.

    Attributes:
        uplink: Which direction.
        sent: By number: when the kernel sent it [ns], wall clock.
        arrived: In the order of arrival: when [ns], wall clock, and the number.
    """

    uplink: bool
    sent: dict[int, int] = field(default_factory=dict)
    arrived: list[tuple[int, int]] = field(default_factory=list)


@dataclass(frozen=True)
class Way:
    """One direction to be sounded.

    Attributes:
        uplink: Which direction.
        target: Where the relay takes in.
        sink: Where it delivers to.
        source: Where datagrams are sent from; None: from any port.
    """

    uplink: bool
    target: Address
    sink: Address
    source: Address | None = None


def run_flow(
    ways: Sequence[Way], rate: float, duration: float, tail: float, begin: float = 0.0
) -> list[Flow]:
    """Send on all ways in turns, and receive.

    Args:
        ways: One or two.
        rate: On each way [1/s].
        duration: Of the sending [s].
        tail: How long to go on receiving [s].
        begin: When to begin [s], monotonic clock; soon if that has passed.

    Returns:
        A flow for each way.
    """
    ends = [_End(way) for way in ways]
    try:
        period_ns = round(_SECOND_NS / rate)
        start_ns = max(time.monotonic_ns() + 10_000_000, round(begin * _SECOND_NS))
        for number in range(round(rate * duration)):
            for turn, end in enumerate(ends):
                due_ns = start_ns + since_first_ns(number, turn, len(ends), period_ns)
                time.sleep(max(0.0, (due_ns - time.monotonic_ns()) * 1e-9))
                end.send(number)
            for end in ends:
                end.drain()
        until = time.monotonic() + tail
        while time.monotonic() < until:
            time.sleep(0.02)
            for end in ends:
                end.drain()
        return [end.flow for end in ends]
    finally:
        for end in ends:
            end.close()


def since_first_ns(number: int, turn: int, turns: int, period_ns: int) -> int:
    """Say when to send a datagram.

    The first begins the link's time. All others stay clear of whole periods since then: where a
    trace or a time line changes just as a datagram leaves, the relay, which sees it come a
    microsecond later than it was sent, may rightly draw its delay from what holds after the change.

    Args:
        number: Of the datagram on its way.
        turn: Of the way, from 0.
        turns: How many ways there are, 1 or 2.
        period_ns: Between two on the same way [ns].

    Returns:
        The instant [ns], since the first.
    """
    if number == turn == 0:
        return 0
    return number * period_ns + turn * period_ns // turns + period_ns // 4


class _End:
    """Source and sink of one direction."""

    def __init__(self, way: Way) -> None:
        self.flow = Flow(way.uplink)
        self._way = way
        self._kind = Kind.TELEMETRY if way.uplink else Kind.COMMAND
        self._source = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._sink = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._source.bind(way.source or ("127.0.0.1", 0))
        flags = _TX_SOFTWARE | _SOFTWARE | _ID | _STAMP_ONLY
        self._source.setsockopt(socket.SOL_SOCKET, _SO_TIMESTAMPING, flags)
        self._sink.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, _BUFFER)
        self._sink.setsockopt(socket.SOL_SOCKET, _SO_TIMESTAMPNS, 1)
        self._sink.bind(way.sink)
        self._sink.setblocking(False)
        self._source.setblocking(False)

    def send(self, number: int) -> None:
        header = encode_header(self._kind, 0 if self._way.uplink else 1, EPOCH, number)
        self._source.sendto(header.ljust(SIZE, b"\0"), self._way.target)

    def drain(self) -> None:
        """Read what has come, and when the kernel sent what was sent."""
        while True:
            try:
                data, ancillary, _, _ = self._sink.recvmsg(SIZE, 64)
            except BlockingIOError:
                break
            number = int.from_bytes(data[8:16], "little")
            self.flow.arrived.append((_stamp(ancillary[0][2]), number))
        while True:
            try:
                _, ancillary, _, _ = self._source.recvmsg(0, 512, socket.MSG_ERRQUEUE)
            except BlockingIOError:
                break
            by_kind = {(level, kind): data for level, kind, data in ancillary}
            error = by_kind[socket.IPPROTO_IP, _IP_RECVERR]
            number = int.from_bytes(error[12:16], sys.byteorder)
            self.flow.sent[number] = _stamp(by_kind[socket.SOL_SOCKET, _SO_TIMESTAMPING][:16])

    def close(self) -> None:
        self._source.close()
        self._sink.close()


def _stamp(data: bytes) -> int:
    seconds, rest = memoryview(data).cast("l")
    return int(seconds * _SECOND_NS + rest)
