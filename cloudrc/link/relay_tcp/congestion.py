"""How many segments of a stream may be on their way, as Linux decides it with CUBIC or with BBR.

Source: RFC 6928 (10 segments), RFC 9438 (CUBIC), Linux, net/ipv4/tcp_cubic.c (HyStart's trains),
net/ipv4/tcp_bbr.c. Deviation: BBR starts and paces, but does not probe round trip and rate later.
"""

from __future__ import annotations

from collections import deque
from math import inf
from typing import Protocol

FIRST_WINDOW = 10.0  # segments
SHRINK, GROWTH = 0.7, 0.4  # CUBIC's factor after a loss, and constant of growth [segments/s^3]
RENO = 0.53  # growth of the window that Reno would have [segments per round trip]
SETTLED_NS = 1_000_000_000  # CUBIC trusts no round trip for this time after a loss [ns]
TRAIN_NS, TRAIN_WINDOW = 2_000_000, 16
"""HyStart: largest gap between acknowledgements of one train [ns], smallest window [segments]."""
SAMPLES, LONGER_NS = 8, (4_000_000, 16_000_000)
"""HyStart: round trips that it measures in a round, and by how much they must be longer [ns]."""
START_GAIN, STEADY_GAIN, ROUNDS = 2.885, 2.0, 10
"""BBR: gain while it looks for the rate of the link and later; rounds that it remembers."""
PLATEAU, PLATEAUS = 1.25, 3
"""BBR: the start ends after this number of rounds whose rate has not grown by this factor."""


class Congestion(Protocol):
    """The window of one stream.

    Attributes:
        window: Largest number of segments on their way.
    """

    window: float

    def acknowledged(self, sent: SentSegment, count: int, now_ns: int, most: int) -> None:
        """Note `count` acknowledged segments, the last of which is `sent`.

        At most `most` segments were on their way in the last round trip.
        """

    def lost(self, now_ns: int) -> None:
        """Note the first loss of a window."""

    def timed_out(self, now_ns: int) -> None:
        """Note that no answer has come."""

    def rested(self, pause_ns: int, retry_ns: int) -> None:
        """Note a pause [ns]; without an answer, a segment is sent again after `retry_ns` [ns]."""

    def spacing_ns(self) -> float:
        """Return the shortest time between two segments [ns]."""


class SentSegment:
    """What a stream knows about a segment that is acknowledged."""

    __slots__ = ("delivered", "limited", "new_round", "rate_of", "recovers", "sent_ns")

    def __init__(self, sent_ns: int, delivered: int, *, limited: bool) -> None:
        """Note the time, the segments acknowledged so far, and whether the program limits."""
        self.sent_ns, self.delivered, self.limited = sent_ns, delivered, limited
        self.new_round = self.recovers = False
        self.rate_of = 0  # segments acknowledged between its sending and its acknowledgement


class Cubic:
    """CUBIC, with its early end of slow start."""

    def __init__(self) -> None:
        self.window, self._threshold = FIRST_WINDOW, inf
        self._peak = 0.0  # window at the last loss
        self._began_ns, self._middle, self._origin, self._reno = 0, 0.0, 0.0, 0.0
        self._least_ns = self._round_ns = self._train_ns = 0
        self._round_least_ns = self._samples = 0  # of this round trip

    def acknowledged(self, sent: SentSegment, count: int, now_ns: int, most: int) -> None:
        """Grow the window, if it has limited the stream."""
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
        """Shrink the window."""
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
        """Grow as if there had been no pause; after time-outs, the window may not fit the link."""
        if self._began_ns:
            self._began_ns += pause_ns
        while pause_ns > retry_ns and self.window > FIRST_WINDOW:
            self._threshold = max(self._threshold, 0.75 * self.window)
            self.window = max(FIRST_WINDOW, 0.5 * self.window)
            pause_ns -= retry_ns

    def spacing_ns(self) -> float:
        """Return 0: CUBIC sends as acknowledgements arrive."""
        return 0.0


class Bbr:
    """BBR: it measures the rate at which segments arrive, and paces by it, whatever is lost."""

    def __init__(self) -> None:
        self.window = FIRST_WINDOW
        self._rates = deque([0.0], maxlen=ROUNDS)  # fastest of each round [segments/ns]
        self._least_ns, self._full, self._plateaus = 0, 0.0, 0
        self._held_ns = 0  # until then, the window does not grow

    def acknowledged(self, sent: SentSegment, count: int, now_ns: int, most: int) -> None:
        """Measure the rate, and set the window to what the link then holds."""
        trip_ns = max(1, now_ns - sent.sent_ns)
        self._least_ns = min(self._least_ns or trip_ns, trip_ns)
        rate = sent.rate_of / trip_ns
        fastest = max(self._rates)
        if sent.new_round:
            self._look_for_plateau(sent)
            self._rates.append(0.0)
        if rate > fastest or not sent.limited:
            self._rates[-1] = max(self._rates[-1], rate)
        elif not max(self._rates):
            self._rates[-1] = fastest
        gain = START_GAIN if self._plateaus < PLATEAUS else STEADY_GAIN
        target = max(4.0, gain * max(self._rates) * self._least_ns)
        if self._plateaus < PLATEAUS:
            grows = self.window < target and now_ns >= self._held_ns
            self.window += count if grows else 0
        else:
            self.window = min(self.window + count, target)

    def _look_for_plateau(self, sent: SentSegment) -> None:
        if sent.limited:
            return
        fastest = max(self._rates)
        if fastest >= PLATEAU * self._full:
            self._full, self._plateaus = fastest, 0
        else:
            self._plateaus += 1

    def lost(self, now_ns: int) -> None:
        """Let the window not grow for one round trip."""
        self._held_ns = now_ns + self._least_ns

    def timed_out(self, now_ns: int) -> None:
        """Change nothing."""

    def rested(self, pause_ns: int, retry_ns: int) -> None:
        """Change nothing."""

    def spacing_ns(self) -> float:
        """Return the time between two segments at the measured rate [ns]; 0 at first."""
        rate = max(self._rates)
        if not rate:
            return 0.0
        return 1.0 / (rate * (START_GAIN if self._plateaus < PLATEAUS else 1.0))


def of_machine(name: str) -> type[Cubic] | type[Bbr]:
    """Return the kind that is nearest to the kernel's congestion control `name`."""
    return Bbr if name.startswith("bbr") else Cubic
