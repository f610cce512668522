"""Compute when the segments of TCP connections cross one direction of the link.

The loss of a segment depends on its place in the bytes of its connection (`stream.py` counts the
places), and the jitter on the time, in slots of 10 ms. So the way in which programs and the kernel
cut the bytes changes neither. If the profile keeps the order of packets, each packet has a jitter
of its own, as in `cloudrc link exec`, because a late packet there holds up those behind it. All
connections share one bottleneck.
"""

from __future__ import annotations

from collections import deque

from cloudrc.errors import BadInputError
from cloudrc.link.draws import BLOCK, Fate, impairments, stream_key
from cloudrc.link.library import KIND
from cloudrc.link.model import enqueue
from cloudrc.link.profile import Conditions, DirectionProfile, Loss, Timeline

SEGMENT = 1448
"""Most bytes of a segment: an IP packet of 1500 bytes, less the headers of IPv4 and TCP with time
stamps [bytes]."""
HEADERS = 52  # headers of IPv4 and of TCP with time stamps [bytes]
SLOT_NS = 10_000_000  # time for which the jitter stays the same [ns]
JITTER = KIND + 1  # kind of the draws of the jitter; those of losses begin behind it
_TABLES = 256  # number of blocks of draws that are kept in memory


def refuse_unsupported(profile: DirectionProfile, name: str) -> None:
    """Raise a BadInputError if bytes of a TCP connection cannot show a key of the profile."""
    for key in ("duplicate", "corrupt", "reorder"):
        if getattr(profile, key):
            raise BadInputError(
                f"{name}.{key}: TCP hands bytes on once, undamaged and in order, so a relay of"
                f" bytes cannot show it; set {name}.{key}=0, or use 'cloudrc link exec'"
            )


class Medium:
    """One direction of the link, for all connections."""

    def __init__(self, profile: DirectionProfile, seed: int, uplink: bool, origin_ns: int) -> None:
        """Make the direction; its time line begins at `origin_ns` [ns]."""
        self._seed, self._uplink, self._origin_ns = seed, uplink, origin_ns
        self._departures = deque[int]()
        self._packets = self._last_ns = 0  # number of packets, and arrival of the last one [ns]
        self.replace_profile(profile)

    def replace_profile(self, profile: DirectionProfile, origin_ns: int | None = None) -> None:
        """Use another profile from now on; with `origin_ns` [ns], its time line begins there."""
        if origin_ns is not None:
            self._origin_ns = origin_ns
        self._profile, self._timeline = profile, Timeline(profile)
        self._tables: dict[tuple[int, int, int, float, Loss], list[Fate]] = {}

    def is_perfect(self, now_ns: int) -> bool:
        """Return whether bytes cross at once."""
        now = self._at(now_ns)
        return not (now.delay_ns or now.jitter or now.loss or now.rate or now.blackout)

    def arrival_ns(self, now_ns: int) -> int:
        """Send a small packet that is never lost; return when it arrives [ns].

        This and `cross` must be called in the order of time.
        """
        return self._pass(self._at(now_ns), 0, now_ns)

    def cross(
        self, connection: int, place: int, attempt: int, size: int, now_ns: int
    ) -> int | None:
        """Send a segment with `size` bytes at `now_ns` [ns].

        `place` counts segments by their bytes, `attempt` is 1 for the first transmission.

        Returns:
            When the segment arrives [ns]; None if it is lost.
        """
        now = self._at(now_ns)
        fate = self._fate(connection, JITTER + attempt, place, 0.0, now.loss)
        if now.blackout or not fate:
            return None
        leaves_ns: int | None = now_ns
        if now.rate is not None:
            packets_max = self._profile.queue_packets
            leaves_ns = enqueue(self._departures, size + HEADERS, now.rate, packets_max, now_ns)
        return None if leaves_ns is None else self._pass(now, fate[0], leaves_ns)

    def _pass(self, now: Conditions, extra_ns: int, leaves_ns: int) -> int:
        """Return when a packet arrives that leaves the bottleneck at `leaves_ns` [ns]."""
        number = (leaves_ns - self._origin_ns) // SLOT_NS
        if self._profile.keep_order:
            self._packets += 1
            number = self._packets
        offset = self._fate(1, JITTER, number, now.jitter, 0.0)[0] if now.jitter else 0
        arrival_ns = leaves_ns + max(0, now.delay_ns + offset + extra_ns)
        if self._profile.keep_order:
            arrival_ns = self._last_ns = max(self._last_ns, arrival_ns)
        return arrival_ns

    def _at(self, now_ns: int) -> Conditions:
        return self._timeline.at(now_ns - self._origin_ns)

    def _fate(self, epoch: int, kind: int, number: int, jitter: float, loss: Loss) -> Fate:
        block, index = divmod(number, BLOCK)
        key = (epoch, kind, block, jitter, loss)
        if key not in self._tables:
            if len(self._tables) >= _TABLES:
                del self._tables[next(iter(self._tables))]
            stream = stream_key(self._seed, self._uplink, epoch, kind)
            self._tables[key] = impairments(stream, block, self._profile, jitter, loss)
        return self._tables[key][index]
