"""Cloud's periods that pass without a command: counts in, a fault out where they are many."""

from __future__ import annotations

from cloudrc.messages import NEVER_NS
from cloudrc.records import Fault

MISSED_MAX = 50
"""So many at a time are a fault worth telling; a few happen on any machine [periods]."""
FORGIVEN_NS = 200_000_000
"""After so long one is forgiven: 5 % of all periods may be missed for ever [ns]."""


class Lateness:
    """Tells when cloud falls behind, and again once all that it has missed is forgiven."""

    def __init__(self) -> None:
        self._missed, self._told = 0, False
        self._forgiven_ns = NEVER_NS  # when all will be

    def miss(self, count: int, now_ns: int) -> list[Fault]:
        """Count missed periods.

        Args:
            count: How many, of 10 ms.
            now_ns: Cloud's monotonic clock [ns].

        Returns:
            What there is to tell: a fault or nothing.
        """
        full_ns = now_ns + MISSED_MAX * FORGIVEN_NS
        if self._forgiven_ns <= now_ns:
            self._missed, self._told, self._forgiven_ns = 0, False, now_ns
        self._missed += count
        self._forgiven_ns = min(self._forgiven_ns + count * FORGIVEN_NS, full_ns)
        if self._told or self._forgiven_ns < full_ns:
            return []
        self._told = True
        text = (
            f"cloud has let {self._missed} periods of 10 ms pass without a command: "
            "a plug-in is slow or the machine is busy"
        )
        return [Fault(now_ns, "late", text)]
