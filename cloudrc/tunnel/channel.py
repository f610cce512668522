"""Classify the datagrams of one stream by their counters as used, late or repeated."""

from __future__ import annotations

WINDOW = 1024
"""Number of counters before the newest counter that a channel remembers."""
_MASK = (1 << WINDOW) - 1

# Outcomes of a datagram, which name the counts.
USED, LATE, REPEATED = "used", "late", "repeated"


class Channel:
    """Classify the datagrams of one kind and direction in one session."""

    def __init__(self, newest_wins: bool) -> None:
        """Start without counters; with `newest_wins`, a datagram older than the newest is late.

        Without `newest_wins`, every datagram that arrives for the first time is used, as in the
        published code. A repeated datagram is never used.
        """
        self._newest_wins = newest_wins
        self.reset()

    def reset(self) -> None:
        """Forget all counters, because a new session restarts the counters."""
        self._newest = -1
        self._seen = 0  # bit k: newest - k has arrived
        self._repeats = 0

    @property
    def is_flooded(self) -> bool:
        """Whether an attacker repeats datagrams: more were repeated than sent."""
        return self._repeats > self._newest + 1

    def take(self, counter: int) -> str:
        """Classify the datagram with this counter as USED, LATE or REPEATED."""
        ahead = counter - self._newest
        if ahead > 0:
            self._newest = counter
            self._seen = ((self._seen << ahead) | 1) & _MASK if ahead < WINDOW else 1
            return USED
        if ahead <= -WINDOW or self._seen >> -ahead & 1:
            self._repeats += 1
            return REPEATED
        self._seen |= 1 << -ahead
        return LATE if self._newest_wins else USED
