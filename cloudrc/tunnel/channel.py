"""Which datagram of a stream counts: newest wins, or the last to arrive as in the paper's code."""

from __future__ import annotations

WINDOW = 1024
"""How far back a counter is remembered [datagrams]."""
_MASK = (1 << WINDOW) - 1


# What became of a datagram, by the name that it is counted under.
USED = "used"
LATE = "late"
REPEATED = "repeated"


class Channel:
    """The receiving end of one stream of counters within one epoch."""

    def __init__(self, newest_wins: bool) -> None:
        """Start empty.

        Args:
            newest_wins: True: a datagram older than the newest is late. False: the last to arrive
                wins, even if it is older (the published code's policy); repeats are still dropped.
        """
        self._newest_wins = newest_wins
        self.reset()

    def reset(self) -> None:
        """Forget everything: a new epoch begins."""
        self._newest = -1
        self._seen = 0  # bit k: newest - k has arrived
        self._repeats = 0

    @property
    def is_flooded(self) -> bool:
        """Whether more was repeated than sent, which no link does: to write it all down is work."""
        return self._repeats > self._newest + 1

    def take(self, counter: int) -> str:
        """Say what becomes of the datagram with this counter: USED, LATE or REPEATED."""
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
