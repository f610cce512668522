"""How early a relay wakes: how late it woke before goes in, how much earlier to wake comes out.

A thread that sleeps until an instant wakes 15 to 50 us after it. So the relay sleeps until a little
before and looks at the clock until it is time. How long that takes is bounded, each time and as a
share of all time: no core is burnt that world or cloud need.
"""

from __future__ import annotations

LEAD_MAX_NS, FIRST_LEAD_MAX_NS = 60_000, 150_000
"""Longest look at the clock, each time [ns]: of an ordinary thread, and of one under SCHED_FIFO.

Later wakes have other causes than the timer: other programs, or other virtual machines.
"""
SHARE_MAX, FIRST_SHARE_MAX = 0.05, 0.10
"""Largest share of a core that goes into looking at the clock, in [0, 1], of either."""

_LEAD_MIN_NS = 5_000
_LEAD_FIRST_NS = 40_000
_RISE_NS, _FALL_NS = 990, 10
_CREDIT_MAX_NS = 10_000_000


class Lead:
    """Follows the 99th percentile of how late the thread wakes.

    Deviation from a sorted window: each wake moves the lead up by 990 ns or down by 10 ns, which
    stays where 1 in 100 wakes is later, costs nothing and follows the machine's load.
    """

    __slots__ = ("_credit_ns", "_most_ns", "_now_ns", "_share", "_wanted_ns")

    def __init__(self, *, first: bool = False) -> None:
        """Begin with what most machines need.

        Args:
            first: Whether the thread runs before every ordinary one.
        """
        self._most_ns = FIRST_LEAD_MAX_NS if first else LEAD_MAX_NS
        self._share = FIRST_SHARE_MAX if first else SHARE_MAX
        self._wanted_ns = _LEAD_FIRST_NS
        self._credit_ns = _CREDIT_MAX_NS
        self._now_ns = 0

    def ahead_ns(self) -> int:
        """Say how long before it is due to wake [ns]; 0 while the share is used up."""
        return self._wanted_ns if self._credit_ns > 0 else 0

    def woke(self, late_ns: int) -> None:
        """Learn how late the thread woke [ns], after the instant that it asked for."""
        if late_ns > self._wanted_ns:
            self._wanted_ns = min(self._wanted_ns + _RISE_NS, self._most_ns)
        else:
            self._wanted_ns = max(self._wanted_ns - _FALL_NS, _LEAD_MIN_NS)

    def looked(self, since_ns: int, until_ns: int) -> None:
        """Learn that it has looked at the clock from one instant [ns] to another."""
        earned_ns = round(self._share * (until_ns - self._now_ns))
        self._now_ns = until_ns
        credit_ns = self._credit_ns + earned_ns - (until_ns - since_ns)
        self._credit_ns = min(credit_ns, _CREDIT_MAX_NS)

    def rests(self, now_ns: int) -> None:
        """Learn at an instant [ns] that it has not looked: time alone earns credit again."""
        if self._credit_ns <= 0:
            self.looked(now_ns, now_ns)
