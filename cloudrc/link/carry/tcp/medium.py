# SPDX-License-Identifier: Apache-2.0

"""Compute when the segments of streams cross one direction of the link.

All connections share one bottleneck. Its queue drops nothing: a sender that finds it full waits.
"""

from __future__ import annotations

from collections import deque
from dataclasses import replace

from cloudrc.link.model import LinkDirection, enqueue
from cloudrc.link.profile import Conditions, DirectionProfile, LinkSchedule
from cloudrc.link.radio import mean_delay

SEGMENT = 1448
"""Most bytes of a segment: an IP packet of 1500 bytes, less the headers of IPv4 and TCP with time
stamps [bytes]."""
HEADERS = 52  # headers of IPv4 and of TCP with time stamps [bytes]
_NO_LIMIT = 1 << 62  # number of packets: `room_ns` has looked at the queue before


class Medium:
    """One direction of the link, for all connections; its methods get the time in its order."""

    def __init__(
        self,
        profile: DirectionProfile,
        seed: int,
        uplink: bool,
        origin_ns: int,
        *,
        stream: str = "",
        headers: int = HEADERS,
    ) -> None:
        """Make the direction; its schedule begins at `origin_ns` [ns].

        `stream` is the name of the link. Each segment has `headers` [bytes] on the wire.
        """
        self._origin_ns: int | None = origin_ns
        self._headers, self._uplink = headers, uplink
        self._start_ns = 0
        self._departures = deque[int]()
        self._link = LinkDirection(profile, seed, uplink, origin_ns, stream=stream)
        self.replace_profile(profile)

    def replace_profile(
        self, profile: DirectionProfile, *, restart: bool = False, start_ns: int = 0
    ) -> None:
        """Use another profile from now on; with `restart`, its schedule is at `start_ns` now."""
        if restart:
            self._origin_ns, self._start_ns = None, start_ns
        self._queue_packets, self._schedule = profile.queue_packets, LinkSchedule(profile)
        self._radio_ns = round(mean_delay(profile, self._uplink) * 1e9)
        changes = tuple(replace(change, rate_kbit=None) for change in profile.changes)
        behind = replace(profile, rate_kbit=None, changes=changes)  # what follows the bottleneck
        if profile.opportunities:  # their bottleneck stays there: a segment that waits is not lost
            behind = replace(behind, queue_packets=_NO_LIMIT)
        self._link.replace_profile(behind, restart=restart, start_ns=start_ns)

    def delay_ns(self, now_ns: int) -> int:
        """Return the delay of a packet without jitter, at a mean phase of a radio [ns]."""
        return self._at(now_ns).delay_ns + self._radio_ns

    def room_ns(self, now_ns: int) -> int:
        """Return when the queue of the bottleneck has room for a segment [ns]."""
        queue = self._departures
        while queue and queue[0] <= now_ns:
            queue.popleft()
        if self._at(now_ns).rate is None or len(queue) < self._queue_packets:
            return now_ns
        return queue[len(queue) - self._queue_packets]

    def cross(self, epoch: int, counter: int, kind: int, size: int, now_ns: int) -> int | None:
        """Send a segment of `size` bytes at `now_ns` [ns].

        Epoch, kind and counter select its random numbers; the epoch is that of its connection.

        Returns:
            When the segment arrives [ns]; None if it is lost.
        """
        rate = self._at(now_ns).rate
        leaves_ns = now_ns
        if rate is not None:
            length = size + self._headers
            leaves_ns = enqueue(self._departures, length, rate, _NO_LIMIT, now_ns) or now_ns
        arrivals = self._link.send_checked(epoch, kind, counter, size, leaves_ns)
        return min(arrivals) if arrivals else None

    def _at(self, now_ns: int) -> Conditions:
        if self._origin_ns is None:
            self._origin_ns = now_ns - self._start_ns
        return self._schedule.at(now_ns - self._origin_ns)
