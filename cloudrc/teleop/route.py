# SPDX-License-Identifier: Apache-2.0

"""Follow the robot's way from waypoint to waypoint: lead it, and detect when it has arrived."""

from __future__ import annotations

from cloudrc.teleop.aim import Aim
from cloudrc.teleop.wire import Leg, Plan, RobotStatus
from cloudrc.wire.messages import NEVER_NS, GuardState, Vector

GAP_MAX_NS = 500_000_000
"""Longest gap in telemetry that counts in full as time of flight [ns]. Of a longer gap only this
time counts, and the carrot starts again from the robot."""
PROMPT_NS = 100_000_000
"""Tolerance for late telemetry [ns]. If telemetry shows the robot at the waypoint at most this long
after the planned time, the carrot leaves as planned, else when telemetry shows the robot there."""
UNSEEN_MAX_NS = 2_000_000_000
"""Longest time without telemetry after which the dwell time at a waypoint continues [ns]."""
GROUND, TRACK, HOLD = GuardState.GROUND, GuardState.TRACK, GuardState.HOLD  # a look-up takes time


class Route:
    """The way of one mission.

    Time in which the robot does not follow cloud's commands does not count.

    Attributes:
        plan: Waypoints, or a track.
        leg: Index of the current waypoint; their number once all are reached.
    """

    def __init__(self, plan: Plan, leg: int, aim: Aim) -> None:
        self.plan, self.leg, self._aim = plan, leg, aim
        # Whether the robot has followed commands in this mission, and whether the carrot waits.
        self._followed = self._waits = False
        self._flown_ns = 0
        self.pause()

    def pause(self) -> None:
        """Interrupt the flight to the waypoint: keep the time flown, but restart the dwell time."""
        self._seen_ns = self._near_since_ns = NEVER_NS

    @property
    def where(self) -> str:
        """Place in the mission, for an event's text, such as "on the way to waypoint 1 of 7"."""
        if self.plan.follow:
            return f"while {self.name}"
        return f"on the way {'along the' if self.plan.track else 'to'} {self.name}"

    @property
    def name(self) -> str:
        """Name of the waypoint, such as "waypoint 1 of 7"."""
        if self.plan.track:
            return self.plan.track_name
        return f"{self.plan.unit} {self.leg + 1} of {len(self.plan.legs)}"

    def select(self, begin_ns: int, start: Vector | None = None) -> None:
        """Make the waypoint the setpoint from `begin_ns` [ns] on; the way begins at `start` [m]."""
        self._aim.select_leg(self.leg, begin_ns, start)

    def lead(self, seen: RobotStatus, now_ns: int) -> None:
        """Keep the carrot, a moving setpoint, at the robot while the guard ignores commands.

        After that, let the carrot move on. At the first take-off, the carrot moves before telemetry
        shows that the robot follows commands: this saves a round trip.
        """
        self._followed = self._followed or seen.guard is TRACK
        seen_ns = self._aim.seen_ns
        if seen.guard is not TRACK and (self._followed or seen.guard is not GROUND):
            self._waits = True
            self._aim.select_here()
        elif self._waits or (seen_ns >= 0 and now_ns - seen_ns > GAP_MAX_NS):
            self._waits = False
            self.select(now_ns)

    def is_reached(self, seen: RobotStatus, now_ns: int) -> bool:
        """Return whether at `now_ns` [ns] the robot has been at the waypoint for the dwell time.

        A robot that follows a carrot only has to be there when the carrot leaves.
        """
        leg = self.plan.legs[self.leg]
        is_there = leg.has(seen)
        rested = self._has_rested(leg, seen, now_ns, is_there=is_there)
        if not leg.speed:
            return rested
        if not is_there:
            return False
        leaves_ns = self._aim.leaves_ns(self.leg)
        return leaves_ns is not None and now_ns >= leaves_ns

    def _has_rested(self, leg: Leg, seen: RobotStatus, now_ns: int, *, is_there: bool) -> bool:
        before_ns, self._seen_ns = self._seen_ns, now_ns
        if seen.guard is HOLD:
            self._near_since_ns = NEVER_NS
            return False
        if before_ns >= 0:
            if seen.guard is not GROUND:  # in GROUND the robot waits
                self._flown_ns += min(now_ns - before_ns, GAP_MAX_NS)
            if now_ns - before_ns > UNSEEN_MAX_NS:
                self._near_since_ns = NEVER_NS  # the robot's path in the gap is unknown
        if not is_there:
            self._near_since_ns = NEVER_NS
            return False
        if self._near_since_ns < 0:
            self._near_since_ns = now_ns
        return now_ns - self._near_since_ns >= leg.dwell * 1e9

    def advance(self, now_ns: int) -> tuple[int, Vector | None]:
        """Go on to the next waypoint; return the arguments of `select` for it."""
        before = self.plan.legs[self.leg]
        leaves_ns = self._aim.leaves_ns(self.leg)
        self.leg += 1
        self._flown_ns = 0
        self.pause()
        start = None if leaves_ns is None else before.position
        if leaves_ns is None or now_ns - leaves_ns > PROMPT_NS:
            leaves_ns = now_ns
        return leaves_ns, start

    def timeout(self) -> str:
        """Say that the robot has flown too long to the waypoint; "" if it has not."""
        leg = self.plan.legs[self.leg]
        if self._flown_ns * 1e-9 < leg.time_limit:
            return ""
        return f"{self.name} not reached in {leg.time_limit:g} s (its time_limit_s)"
