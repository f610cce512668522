"""How many segments of a stream may be on their way, as Linux decides it with CUBIC.

Source: RFC 6928 (10 segments), RFC 9438 (CUBIC), Linux, net/ipv4/tcp_cubic.c (HyStart's trains).
"""

from __future__ import annotations

from math import inf

FIRST_WINDOW = 10.0  # segments
SHRINK, GROWTH = 0.7, 0.4  # CUBIC's factor after a loss, and constant of growth [segments/s^3]
RENO = 0.53  # growth of the window that Reno would have [segments per round trip]
SETTLED_NS = 1_000_000_000  # CUBIC trusts no round trip for this time after a loss [ns]
TRAIN_NS, TRAIN_WINDOW = 2_000_000, 16
"""HyStart: largest gap between acknowledgements of one train [ns], smallest window [segments]."""
SAMPLES, LONGER_NS = 8, (4_000_000, 16_000_000)
"""HyStart: round trips that it measures in a round, and by how much they must be longer [ns]."""


class SentSegment:
    """What a stream knows about a segment that is acknowledged."""

    __slots__ = ("new_round", "recovers", "sent_ns")

    def __init__(self, sent_ns: int) -> None:
        """Note the time [ns]."""
        self.sent_ns = sent_ns
        self.new_round = self.recovers = False


class Cubic:
    """CUBIC of one stream, with its early end of slow start.

    Attributes:
        window: Largest number of segments on their way.
    """

    def __init__(self) -> None:
        self.window, self._threshold = FIRST_WINDOW, inf
        self._peak = 0.0  # window at the last loss
        self._began_ns, self._middle, self._origin, self._reno = 0, 0.0, 0.0, 0.0
        self._least_ns = self._round_ns = self._train_ns = 0
        self._round_least_ns = self._samples = 0  # of this round trip

    def acknowledged(self, sent: SentSegment, count: int, now_ns: int, most: int) -> None:
        """Grow the window by `count` acknowledged segments, the last of which is `sent`.

        It grows only if it has limited the stream: at most `most` segments were on their way in the
        last round trip.
        """
        trip_ns = now_ns - sent.sent_ns
        if not self._began_ns or now_ns - self._began_ns >= SETTLED_NS:
            self._least_ns = min(self._least_ns or trip_ns, trip_ns)
        if sent.recovers:
            return
        if self.window < self._threshold:
            self._end_start(sent, trip_ns, now_ns)
            if self.window < 2 * most:
                self.window = min(self.window + count, max(self._threshold, self.window))
        elif most >= self.window - 1.0:
            self._grow(count, now_ns)

    def _grow(self, count: int, now_ns: int) -> None:
        """Follow the cubic function of time, or the window that Reno would have if it is larger."""
        if not self._began_ns:
            self._began_ns, self._reno = now_ns, self.window
            self._origin = max(self._peak, self.window)
            self._middle = ((self._origin - self.window) / GROWTH) ** (1 / 3)
        since = (now_ns - self._began_ns + self._least_ns) * 1e-9
        wanted = GROWTH * (since - self._middle) ** 3 + self._origin
        self._reno += RENO * count / self.window
        wanted = max(wanted, self._reno)
        step = max(0.01, wanted - self.window)  # in one round trip
        if not self._peak:
            step = max(step, 0.05 * self.window)
        self.window += min(step / self.window, 0.5) * count

    def _end_start(self, sent: SentSegment, trip_ns: int, now_ns: int) -> None:
        """End slow start if round trips get longer, or the train of acknowledgements is long."""
        if sent.new_round:
            self._round_ns = self._train_ns = now_ns
            self._round_least_ns, self._samples = trip_ns, 0
        if self.window < TRAIN_WINDOW:
            return
        is_long = False
        if now_ns - self._train_ns <= TRAIN_NS:
            self._train_ns = now_ns
            is_long = now_ns - self._round_ns > self._least_ns // 2
        self._round_least_ns = min(self._round_least_ns, trip_ns)
        self._samples += 1
        more_ns = min(max(self._least_ns // 8, LONGER_NS[0]), LONGER_NS[1])
        if self._samples > SAMPLES:
            is_long |= self._round_least_ns > self._least_ns + more_ns
        if is_long:
            self._threshold = self.window

    def lost(self, now_ns: int) -> None:
        """Shrink the window, at its first loss."""
        falls = self.window < self._peak  # another stream wants room, too
        self._peak = self.window * ((1.0 + SHRINK) / 2 if falls else 1.0)
        self._began_ns = 0
        self._threshold = self.window = max(2.0, SHRINK * self.window)

    def timed_out(self, now_ns: int) -> None:
        """Begin again with one segment."""
        if self.window > 1.0:
            self.lost(now_ns)
        self.window = 1.0

    def rested(self, pause_ns: int, retry_ns: int) -> None:
        """Grow as if there had been no pause [ns]; after a long one, shrink the window.

        It may not fit the link any more. Without an answer, a segment is sent again after
        `retry_ns` [ns].
        """
        if self._began_ns:
            self._began_ns += pause_ns
        while pause_ns > retry_ns and self.window > FIRST_WINDOW:
            self._threshold = max(self._threshold, 0.75 * self.window)
            self.window = max(FIRST_WINDOW, 0.5 * self.window)
            pause_ns -= retry_ns
