# SPDX-License-Identifier: Apache-2.0

"""Note what happened to packets: how late each one left, and its times on the link."""

from __future__ import annotations

from array import array
from collections import Counter
from collections.abc import Sequence

QUANTILES = {"p50": 0.5, "p99": 0.99, "p999": 0.999}  # name -> quantile of the lateness, in [0, 1]
LOGGED_MAX = 1_000_000  # packets of a direction that are recorded
LOST = -1  # time of a packet that does not arrive
PENDING = -2  # time of a packet of which it is not known yet
_BITS = 7  # number of significant bits of a lateness that select its bucket: buckets are 1.6 % wide
_EARLY = -1  # bucket of the packets that left before they were due


class ReleaseErrors(Counter[int]):
    """Histogram of the lateness of packets: bucket (a range of lateness) -> count."""

    @property
    def early(self) -> int:
        """Number of packets that left before they were due, which is a fault."""
        return self[_EARLY]

    def observe(self, error_ns: int) -> None:
        """Count one packet that left `error_ns` [ns] after it was due."""
        shift = max(0, error_ns.bit_length() - _BITS)
        self[_EARLY if error_ns < 0 else (shift << _BITS) + (error_ns >> shift)] += 1

    def in_ns(self) -> dict[str, int]:
        """Return counts and percentiles of the lateness; another thread may count meanwhile.

        Returns:
            `released`, the number of packets; `released_early`, those that left before they were
            due; and the percentiles `release_error_p50_ns`, `_p99_ns` and `_p999_ns` [ns]. The
            dictionary is empty before the first packet.
        """
        counts, below = sorted(self.copy().items()), 0
        whole = sum(number for _, number in counts)
        wanted = [(f"release_error_{name}_ns", share) for name, share in QUANTILES.items()]
        found = {"released": whole, "released_early": self.early} if whole else {}
        for bucket, number in counts:
            below += number
            shift, start = divmod(max(bucket, 0), 1 << _BITS)
            while wanted and below >= wanted[0][1] * whole:
                found[wanted.pop(0)[0]] = (start + 1) << shift
        return found


class PacketLog:
    """What happened to the packets of one direction: an entry per packet in each array.

    Times are on the monotonic clock [ns]. `due` and `left` are LOST for a packet that did not
    arrive; `due` is PENDING while a loss is repaired. `left` is that of the copy that left first.
    """

    def __init__(self, limit: int = LOGGED_MAX) -> None:
        """Note at most `limit` packets."""
        self._limit = limit
        self.sent, self.size, self.due, self.left = (array("q") for _ in range(4))
        self.copies = array("b")

    def __len__(self) -> int:
        return len(self.sent)

    def enter(self, sent_ns: int, size: int, arrivals: Sequence[int]) -> None:
        """Note the next packet, which is due at `arrivals` [ns]; `size`: with headers [bytes]."""
        if len(self.sent) < self._limit:
            self.sent.append(sent_ns)
            self.size.append(size)
            self.due.append(min(arrivals) if arrivals else LOST)
            self.left.append(LOST)
            self.copies.append(0)

    def arrive(self, number: int, due_ns: int) -> None:
        """Note when the packet `number`, which was PENDING, is due."""
        if number < len(self.due):
            self.due[number] = due_ns

    def leave(self, number: int, now_ns: int) -> None:
        """Note that a copy of the packet `number` has left."""
        if number < len(self.copies):
            if not self.copies[number]:
                self.left[number] = now_ns
            self.copies[number] += 1
