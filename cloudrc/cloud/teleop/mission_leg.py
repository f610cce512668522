"""One leg as it is flown: the robot as seen comes in; whether it is there, or late, goes out.

Only time in which the robot is seen to fly on the cloud's commands counts: while the link is silent
or the guard holds, and on the ground, it does not do what the leg is for, and waits.
"""

from __future__ import annotations

from math import dist

from cloudrc.cloud.teleop.messages import Seen, State
from cloudrc.cloud.teleop.plan import Leg, Plan
from cloudrc.messages import NEVER_NS, GuardState

GAP_MAX_NS = 500_000_000
"""Of a longer silence between two telemetries only so much counts as flown [ns]."""
UNSEEN_MAX_NS = 2_000_000_000
"""After a longer one nobody knows where the robot was meanwhile [ns]."""
GROUND, HOLD = GuardState.GROUND, GuardState.HOLD  # looked up with every telemetry


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
            if seen.guard is not GROUND:  # where it waits until it may take off
                self._flown_ns += min(now_ns - before_ns, GAP_MAX_NS)
            if now_ns - before_ns > UNSEEN_MAX_NS:
                self._near_since_ns = NEVER_NS  # where it was meanwhile nobody knows
        if dist(seen.position, leg.position) > leg.tolerance:
            self._near_since_ns = NEVER_NS
            return False
        if self._near_since_ns < 0:
            self._near_since_ns = now_ns
        return now_ns - self._near_since_ns >= leg.dwell * 1e9


def where(plan: Plan, leg: int) -> str:
    """Say which waypoint is flown to."""
    return f"waypoint {leg + 1} of {len(plan.legs)}"


def overdue(
    plan: Plan, leg: int, state: State, elapsed: float, flown: float
) -> tuple[str, str] | None:
    """Say which limit of time is over, if one is: code and text.

    Args:
        plan: Of the mission.
        leg: Index of the waypoint that is flown to.
        state: Of the mission, which is under way.
        elapsed: Since the mission began, or was asked for [s].
        flown: How long the leg has been flown [s].
    """
    limit, leg_limit = plan.time_limit, plan.legs[leg].time_limit
    if elapsed >= limit and state is State.STARTING:
        return "timed_out", f"the robot has not started within {limit:g} s; is the link up?"
    if elapsed >= limit:
        text = f"mission not done within {limit:g} s: on the way to {where(plan, leg)}"
        return "timed_out", text
    if flown >= leg_limit and state is State.FLYING:
        return "leg_timed_out", f"{where(plan, leg)} not reached in {leg_limit:g} s"
    return None
