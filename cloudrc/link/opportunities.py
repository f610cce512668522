# SPDX-License-Identifier: Apache-2.0

"""A bottleneck that serves packets at recorded instants, as mahimahi replays a cellular link.

At each opportunity 1500 bytes may leave. What a packet leaves over serves the packets that wait
behind it; an opportunity for which no packet waits is lost.

Source: R. Netravali et al., "Mahimahi: accurate record-and-replay for HTTP", USENIX ATC 2015.
"""

from __future__ import annotations

from bisect import bisect_left
from collections.abc import Sequence

BYTES = 1500
"""What may leave at an opportunity [bytes]."""


class Opportunities:
    """Says when packets leave a bottleneck, in the order of their arrival."""

    def __init__(self, times_ns: Sequence[int]) -> None:
        """Begin with all opportunities, at `times_ns` and then again after the last one."""
        self._times_ns, self._period_ns = times_ns, times_ns[-1]
        self.restart()

    def restart(self) -> None:
        """Begin before the first opportunity."""
        self._place = -1  # of the opportunity at which the last packet left, counted from the first
        self._left = 0  # what may still leave there [bytes]

    def leave_ns(self, size: int, now_ns: int) -> int:
        """Return when a packet of `size` bytes leaves that arrives at `now_ns` of the schedule."""
        passes, rest_ns = divmod(now_ns, self._period_ns)
        first = passes * len(self._times_ns) + bisect_left(self._times_ns, rest_ns)
        if first > self._place:
            self._place, self._left = first, BYTES
        while size > self._left:
            size -= self._left
            self._place, self._left = self._place + 1, BYTES
        self._left -= size
        passes, place = divmod(self._place, len(self._times_ns))
        return passes * self._period_ns + self._times_ns[place]
