"""Predictions and delay estimates held to what arrives later: control periods in, errors out.

Everything is computed from `Control` records, on the clock that each stamp belongs to, so it works
without a shared clock.
"""

from __future__ import annotations

from heapq import heappop, heappush
from math import nan

from cloudrc.messages import NEVER_NS, Vector
from cloudrc.records import Control

GAP_MAX_NS = 50_000_000
"""Between measurements further apart nothing is interpolated, and nothing judged [ns]."""
WAITING_MAX = 256
"""Predictions that wait for their measurement; a horizon of 1 s leaves 100."""


class PredictionJudge:
    """Compares each position predicted for an instant with the one measured at that instant.

    Attributes:
        error: The newest: predicted minus measured [m], shape (3,); NaN before the first.
        square: Sum of the squared lengths of all errors [m^2].
        judged: Number of predictions compared.
    """

    def __init__(self) -> None:
        """Begin with nothing predicted."""
        self.error: Vector = (nan, nan, nan)
        self.square = 0.0
        self.judged = 0
        self.reset()

    def reset(self) -> None:
        """Forget predictions and measurements: a new session begins."""
        self._waiting: list[tuple[int, Vector]] = []
        self._measured_ns = NEVER_NS
        self._measured: Vector = (nan, nan, nan)

    def take(self, control: Control) -> None:
        """Take a period's measurement, judge what was predicted up to it, keep its prediction."""
        stamp_ns, waiting = control.basis_stamp_ns, self._waiting
        if stamp_ns > self._measured_ns:
            before_ns, before = self._measured_ns, self._measured
            self._measured_ns, self._measured = stamp_ns, control.measured
            while waiting and waiting[0][0] <= stamp_ns:
                at_ns, predicted = heappop(waiting)
                if before_ns <= at_ns and stamp_ns - before_ns <= GAP_MAX_NS:
                    share = (at_ns - before_ns) / (stamp_ns - before_ns)
                    self._judge(predicted, before, control.measured, share)
        if len(waiting) < WAITING_MAX:
            heappush(waiting, (stamp_ns + int(control.horizon * 1e9), control.position))

    def _judge(self, predicted: Vector, before: Vector, after: Vector, share: float) -> None:
        (px, py, pz), (ax, ay, az), (bx, by, bz) = predicted, before, after
        x = px - ax - share * (bx - ax)
        y = py - ay - share * (by - ay)
        z = pz - az - share * (bz - az)
        self.error = (x, y, z)
        self.square += x * x + y * y + z * z
        self.judged += 1


class DelayJudge:
    """Compares each delay estimate with the time that passed until its command was applied.

    An echo tells when a command was applied on world's clock: the echoing odometry's stamp minus
    the hold. Its age in cloud tells which command it was.

    Attributes:
        error: The newest: estimate minus what really passed [s]; NaN before the first.
    """

    def __init__(self) -> None:
        """Begin with nothing estimated."""
        self.error = nan
        self.reset()

    def reset(self) -> None:
        """Forget the commands: a new session begins."""
        self._sent: dict[int, Control] = {}
        self._sent_before: dict[int, Control] = {}

    def sent(self, control: Control) -> None:
        """Remember a command."""
        if len(self._sent) >= WAITING_MAX:
            self._sent_before, self._sent = self._sent, {}
        self._sent[control.stamp_ns] = control

    def echoed(self, control: Control, arrival_ns: int) -> None:
        """Judge the command that this period's odometry echoed.

        Args:
            control: Of the first period after the echo.
            arrival_ns: When that odometry arrived [ns], cloud's clock.
        """
        stamp_ns = arrival_ns - round(control.loop_delay * 1e9)
        sent = self._sent.get(stamp_ns) or self._sent_before.get(stamp_ns)
        if sent is not None:
            applied_ns = control.basis_stamp_ns - round((control.loop_delay - control.rtt) * 1e9)
            self.error = sent.horizon - (applied_ns - sent.basis_stamp_ns) * 1e-9
