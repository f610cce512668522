"""One leg as it is flown: the robot as seen comes in; whether it is there, and how long it flew.

Only time in which the robot is seen to fly on the cloud's commands counts: while the link is silent
or the guard holds, it does not do what the leg is for, and waits.
"""

from __future__ import annotations

from math import dist

from cloudrc.cloud.teleop.messages import Seen
from cloudrc.cloud.teleop.plan import Leg
from cloudrc.messages import NEVER_NS, GuardState

GAP_MAX_NS = 500_000_000
"""Of a longer silence between two telemetries only so much counts as flown [ns]."""
HOLD = GuardState.HOLD  # looked up with every telemetry


class LegWatch:
    """Watches the robot on its way to a waypoint."""

    def __init__(self) -> None:
        self.begin()

    def begin(self) -> None:
        """A new leg begins."""
        self._flown_ns = 0
        self.pause()

    def pause(self) -> None:
        """The leg is not flown for a while: the time flown is kept, the time near is not."""
        self._seen_ns = self._near_since_ns = NEVER_NS

    @property
    def flown(self) -> float:
        """How long the leg has been flown [s]."""
        return self._flown_ns * 1e-9

    def is_reached(self, leg: Leg, seen: Seen, now_ns: int) -> bool:
        """True once the robot has been seen near the waypoint for as long as the leg asks.

        Args:
            leg: That is flown.
            seen: The newest telemetry.
            now_ns: When it arrived [ns].
        """
        before_ns, self._seen_ns = self._seen_ns, now_ns
        if seen.guard is HOLD:
            self._near_since_ns = NEVER_NS
            return False
        if before_ns >= 0:
            self._flown_ns += min(now_ns - before_ns, GAP_MAX_NS)
        if dist(seen.position, leg.position) > leg.tolerance:
            self._near_since_ns = NEVER_NS
            return False
        if self._near_since_ns < 0:
            self._near_since_ns = now_ns
        return now_ns - self._near_since_ns >= leg.dwell * 1e9
