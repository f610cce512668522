"""When a datagram came: the kernel's stamps go in, instants of the monotonic clock come out.

The kernel stamps a datagram as it arrives (SO_TIMESTAMPNS), however long it then waits in the
socket, but by the wall clock, which people and NTP set. So a stamp is turned into an age at once,
and what counts is the monotonic clock minus that age.
"""

from __future__ import annotations

import socket
import struct
import sys
import time
from collections.abc import Sequence
from typing import TypeAlias

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
_SECOND_NS = 1_000_000_000
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
