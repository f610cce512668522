"""What arrives in one direction: counters come in; expected, lost and reordered are counted."""

from __future__ import annotations

WINDOW = 128
"""So many datagrams later one that has not arrived is lost: 1.28 s at 100 Hz."""
_MASK = (1 << WINDOW) - 1
_OLDEST = 1 << (WINDOW - 1)


class Stream:
    """The counters of one direction, epoch by epoch.

    Attributes:
        lost: Datagrams that had not arrived when they left the window.
        reordered: Datagrams that arrived after a newer one; repeated ones are none.
    """

    __slots__ = ("_before", "_epoch", "_first", "_newest", "_seen", "lost", "reordered")

    def __init__(self) -> None:
        """Begin before the first datagram."""
        self.lost = self.reordered = 0
        self._before = 0  # expected in earlier epochs
        self._epoch = self._first = self._newest = -1
        self._seen = _MASK  # bit k: newest - k has arrived

    @property
    def expected(self) -> int:
        """How many datagrams have left the window: those that are judged, arrived or lost."""
        return self._before + max(0, self._newest - self._first - WINDOW + 1)

    def take(self, epoch: int, counter: int) -> bool:
        """Note that the datagram with this counter has arrived; True if it is sure to be new.

        Any other may be one that was caught and sent again, which takes no key.
        """
        if epoch != self._epoch:
            # What was sent before the first arrival may have been sent to nobody: not judged.
            self._before = self.expected
            self._epoch, self._first, self._newest, self._seen = epoch, counter, counter, _MASK
            return True
        ahead = counter - self._newest
        if ahead == 1:
            if not self._seen & _OLDEST:
                self.lost += 1
            self._seen = (self._seen << 1 | 1) & _MASK
            self._newest = counter
        elif ahead > 1:
            self._skip(ahead)
            self._newest = counter
        elif ahead > -WINDOW and not self._seen >> -ahead & 1:
            self._seen |= 1 << -ahead
            self.reordered += 1
        else:
            return False
        return True

    def _skip(self, ahead: int) -> None:
        """Move the window; those between never arrive, or late."""
        leaving = min(ahead, WINDOW)
        self.lost += leaving - (self._seen >> (WINDOW - leaving)).bit_count()
        self.lost += ahead - leaving
        self._seen = (self._seen << ahead | 1) & _MASK if ahead < WINDOW else 1
