"""Whether simulated time keeps up with the machine's: looks of world's clock in, a fault out.

What is slow is the robot, not its network, so a run like that is invalid: who watches it is told
while it flies, and the metric goes on telling.
"""

from __future__ import annotations

from cloudrc.messages import NEVER_NS
from cloudrc.records import REAL_TIME_FACTOR_MIN, Fault

QUIET_NS = 10_000_000_000
"""It is told again once it has kept up for so long [ns]."""


class Pace:
    """Compares each look with the one before; the first, after a process's start, tells nothing."""

    def __init__(self) -> None:
        self._looked_ns = self._slip_ns = NEVER_NS
        self._slow_ns = NEVER_NS

    def look(self, now_ns: int, slip_ns: int) -> list[Fault]:
        """Say so if world has fallen behind since the look before, about a second ago.

        Args:
            now_ns: World's clock [ns].
            slip_ns: By how much it lags the machine's [ns].
        """
        passed_ns, slipped_ns = now_ns - self._looked_ns, slip_ns - self._slip_ns
        is_first = self._looked_ns == NEVER_NS
        self._looked_ns, self._slip_ns = now_ns, slip_ns
        factor = passed_ns / (passed_ns + slipped_ns)
        if is_first or factor >= REAL_TIME_FACTOR_MIN:
            return []
        is_news = self._slow_ns == NEVER_NS or now_ns - self._slow_ns > QUIET_NS
        self._slow_ns = now_ns
        text = (
            f"real-time factor {factor:.2f} over {(passed_ns + slipped_ns) * 1e-9:.1f} s: "
            "simulated time falls behind; give world more processor time"
        )
        return [Fault(now_ns, "late", text)] if is_news else []
