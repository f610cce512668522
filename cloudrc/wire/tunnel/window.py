# SPDX-License-Identifier: Apache-2.0

"""Decide by the counter of each datagram whether it is to be used, is late, or is repeated."""

from __future__ import annotations

WINDOW = 1024
"""Number of counters, up to the newest, for which a window remembers whether the datagram has
arrived. A datagram with an older counter counts as repeated."""
_MASK = (1 << WINDOW) - 1

# Outcomes of a datagram, which name the counts.
USED, LATE, REPEATED = "used", "late", "repeated"


class ReceiveWindow:
    """Classifies datagrams of one kind and direction as used, late or repeated, in one session."""

    def __init__(self, newest_wins: bool) -> None:
        """Set the rule for a datagram that arrives after a newer datagram.

        If `newest_wins` is True, the datagram is late and not used. Otherwise it is used, as in the
        authors' published code. A repeated datagram is never used.
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
        """Whether the repeats that arrived in this session outnumber all datagrams of the sender.

        Only an attacker repeats so many datagrams. The receiver then no longer records repeats.
        """
        return self._repeats > self._newest + 1

    def take(self, counter: int, newest_wins: bool = False) -> str:
        """Classify the datagram with this counter as USED, LATE or REPEATED.

        With `newest_wins` = True, a datagram that arrives after a newer datagram is LATE, whatever
        the rule of the window.
        """
        ahead = counter - self._newest
        if ahead > 0:
            self._newest = counter
            self._seen = ((self._seen << ahead) | 1) & _MASK if ahead < WINDOW else 1
            return USED
        if ahead <= -WINDOW or self._seen >> -ahead & 1:
            self._repeats += 1
            return REPEATED
        self._seen |= 1 << -ahead
        return LATE if newest_wins or self._newest_wins else USED
