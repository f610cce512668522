"""Send numbered datagrams through a link, and compare what arrives with what the model draws.

The kernel stamps each datagram when it leaves and when it arrives (wall clock), so that late wakes
of Python do not matter.
"""

from __future__ import annotations

import socket
import sys
import time
from collections.abc import Sequence
from contextlib import ExitStack, suppress
from dataclasses import dataclass, field
from itertools import pairwise
from typing import NamedTuple, TypeAlias

import numpy as np
from numpy.typing import NDArray

from cloudrc.link.model import LinkDirection
from cloudrc.link.profile import DirectionProfile
from cloudrc.tunnel.codec import Kind, encode_header

Address: TypeAlias = tuple[str, int]
Array: TypeAlias = NDArray[np.float64]

SIZE = 172
"""Length of a datagram, about that of telemetry [bytes]."""
EPOCH, SEED = 1, 1
TIE_NS = 5_000
"""Difference of two due instants below which their order is chance [ns]."""
# Source: Linux, include/uapi/asm-generic/socket.h, linux/net_tstamp.h, linux/errqueue.h.
_SO_TIMESTAMPNS, _SO_TIMESTAMPING, _IP_RECVERR = 35, 37, 11
_TX_SOFTWARE, _SOFTWARE, _ID, _STAMP_ONLY = 1 << 1, 1 << 4, 1 << 7, 1 << 11


class Way(NamedTuple):
    """One direction of a link: `source` sends to `target`, and the link delivers to `sink`."""

    uplink: bool
    target: Address
    sink: Address
    source: Address


@dataclass
class Flow:
    """Number -> time of sending, and (time, number) of each arrival [ns, wall clock]."""

    uplink: bool
    sent: dict[int, int] = field(default_factory=dict)
    arrived: list[tuple[int, int]] = field(default_factory=list)


class Judged(NamedTuple):
    """Differences between a flow and the model, as counts of datagrams except `errors`.

    `errors` are the measured minus the drawn delays of all arrivals, copies included [s].
    """

    errors: Array
    wrongly_lost: int
    wrongly_arrived: int
    swapped: int


def run_flow(
    ways: Sequence[Way], rate: float, duration: float, tail: float, begin: float = 0.0
) -> list[Flow]:
    """Send on one or two ways in turns at `rate` [1/s] each for `duration` [s], and receive.

    Receiving ends `tail` [s] later. Sending begins at `begin` [s], monotonic clock, or soon.
    """
    flows = [Flow(way.uplink) for way in ways]
    addresses = {address for way in ways for address in (way.source, way.sink)}
    with ExitStack() as opened:
        ends = {address: opened.enter_context(_open(address)) for address in addresses}

        def drain() -> None:
            for way, flow in zip(ways, flows, strict=True):
                _drain(ends[way.sink], ends[way.source], flow)

        period_ns = round(1e9 / rate)
        start_ns = max(time.monotonic_ns() + 10_000_000, round(begin * 1e9))
        for number in range(round(rate * duration)):
            for turn, way in enumerate(ways):
                due_ns = start_ns + since_first_ns(number, turn, len(ways), period_ns)
                time.sleep(max(0.0, (due_ns - time.monotonic_ns()) * 1e-9))
                ends[way.source].sendto(_datagram(way.uplink, number), way.target)
            drain()
        until = time.monotonic() + tail
        while time.monotonic() < until:
            time.sleep(0.02)
            drain()
    return flows


def since_first_ns(number: int, turn: int, turns: int, period_ns: int) -> int:
    """Return when to send a datagram, as time since the first one [ns].

    The first datagram starts the link's time. No other datagram leaves at a whole period after it,
    because traces change there. The relay receives a datagram a microsecond after it left, so the
    relay could correctly draw the delay from the next row.
    """
    if number == turn == 0:
        return 0
    return number * period_ns + turn * period_ns // turns + period_ns // 4


def judge(flow: Flow, profile: DirectionProfile, origin_ns: int) -> Judged:
    """Compare a flow with the model; the relay saw its first datagram at `origin_ns` [ns]."""
    model = LinkDirection(profile, SEED, flow.uplink, origin_ns)
    due: dict[int, list[int]] = {}
    for number in sorted(flow.sent):
        releases = model.send(EPOCH, _kind(flow.uplink), number, SIZE, flow.sent[number])
        due[number] = sorted(releases, reverse=True)
    errors, order, too_many = [], [], 0
    for at_ns, number in flow.arrived:
        if due[number]:
            order.append(due[number].pop())
            errors.append(at_ns - order[-1])
        else:
            too_many += 1
    swapped = sum(a > b + TIE_NS for a, b in pairwise(order))
    missing = sum(map(len, due.values()))
    return Judged(np.array(errors, dtype=float) * 1e-9, missing, too_many, swapped)


def _kind(uplink: bool) -> Kind:
    return Kind.TELEMETRY if uplink else Kind.COMMAND


def _datagram(uplink: bool, number: int) -> bytes:
    return encode_header(_kind(uplink), 0 if uplink else 1, EPOCH, number).ljust(SIZE, b"\0")


def _open(address: Address) -> socket.socket:
    one = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    one.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4 << 20)
    one.setsockopt(socket.SOL_SOCKET, _SO_TIMESTAMPNS, 1)
    flags = _TX_SOFTWARE | _SOFTWARE | _ID | _STAMP_ONLY
    one.setsockopt(socket.SOL_SOCKET, _SO_TIMESTAMPING, flags)
    one.setblocking(False)
    one.bind(address)
    return one


def _drain(sink: socket.socket, source: socket.socket, flow: Flow) -> None:
    """Read the arrivals at `sink`, and the kernel's stamps of the datagrams that `source` sent."""
    with suppress(BlockingIOError):
        while True:
            data, ancillary, _, _ = sink.recvmsg(SIZE, 512)
            stamp = next(value for _, kind, value in ancillary if kind == _SO_TIMESTAMPNS)
            flow.arrived.append((_stamp(stamp), int.from_bytes(data[8:16], "little")))
    with suppress(BlockingIOError):
        while True:
            _, ancillary, _, _ = source.recvmsg(0, 512, socket.MSG_ERRQUEUE)
            by_kind = {(level, kind): data for level, kind, data in ancillary}
            error = by_kind[socket.IPPROTO_IP, _IP_RECVERR]
            number = int.from_bytes(error[12:16], sys.byteorder)
            flow.sent[number] = _stamp(by_kind[socket.SOL_SOCKET, _SO_TIMESTAMPING][:16])


def _stamp(data: bytes) -> int:
    seconds, rest = memoryview(data).cast("l")
    return int(seconds * 1_000_000_000 + rest)
