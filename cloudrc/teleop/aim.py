# SPDX-License-Identifier: Apache-2.0

"""Choose the setpoint: at a waypoint, on the way to it, on a track, driven by hand, or here."""

from __future__ import annotations

from bisect import bisect_right
from collections.abc import Callable
from math import dist
from operator import add

from cloudrc.physics.geometry.fence import Fence
from cloudrc.physics.geometry.vectors import turn_to
from cloudrc.teleop.carrot import ACCELERATION, arrival_ns, setpoint_at, steer
from cloudrc.teleop.wire import Leg, Plan, RobotStatus
from cloudrc.wire.messages import NEVER_NS, Drive, Motion, Setpoint, Vector

NO_WAYPOINT = -1
"""Waypoint index in a setpoint or event that belongs to no waypoint."""
NO_PLAN = Plan(())
"""Plan before the first mission."""
JUMP_SPEED = 6.0
"""Highest speed of the setpoint on a track [m/s]; along a faster part the setpoint jumps."""
COAST = 0.3
"""Time that the robot needs to stop at the end of a turn by hand [s]."""


class Aim:
    """The setpoint that teleop sends, and the robot's newest status, at which it may stay.

    Attributes:
        setpoint: The present setpoint; None before the first.
        seen: Newest telemetry; None before the first.
        seen_ns: Time at which the telemetry before has arrived [ns].
        stays: Whether waypoints are ignored.
    """

    def __init__(self, fence: Fence, send: Callable[[Setpoint], object]) -> None:
        """Begin without a setpoint, in a scene with `fence`; `send` gets each new setpoint."""
        self._fence, self._send = fence, send
        self.setpoint: Setpoint | None = None
        self.seen: RobotStatus | None = None
        self.seen_ns = NEVER_NS
        self.stays = False
        self._plan = NO_PLAN
        self._knot = -1  # index of the point of the track that the setpoint has left last

    @property
    def is_driven(self) -> bool:
        """Whether the setpoint moves with a velocity, by hand or along a track."""
        return self.setpoint is not None and type(self.setpoint.motion) is Drive

    def begin(self, plan: Plan) -> None:
        """Begin a mission: its track is followed from the first point on."""
        self._plan, self._knot = plan, -1

    def select(self, setpoint: Setpoint) -> None:
        """Make and send a setpoint for the session in telemetry."""
        epoch = 0 if self.seen is None else self.seen.epoch
        self.setpoint = setpoint._replace(epoch=epoch)
        self._send(self.setpoint)

    def select_here(self) -> None:
        """Make the robot's position the setpoint."""
        if self.seen is not None:
            x, y, z = self.seen.position
            z = max(z, self._fence.inner_low[2])  # lower, the robot would scrape along the ground
            self.select_point(Leg((x, y, z)))

    def select_point(self, leg: Leg) -> None:
        """Make a point the setpoint that is no waypoint of the mission."""
        self.select(self._setpoint_of(leg, NO_WAYPOINT))

    def select_leg(self, waypoint: int, begin_ns: int, start: Vector | None = None) -> None:
        """Make a waypoint the setpoint, or move the setpoint to it if the leg has a speed.

        The motion begins at the time `begin_ns` [ns], from the point `start` [m] or, by default,
        from the robot.
        """
        leg, motion = self._plan.legs[waypoint], None
        if leg.speed and self.seen is not None:
            motion = Motion(start or self.seen.position, begin_ns, leg.speed, leg.acceleration)
        if not self.stays:
            self.select(self._setpoint_of(leg, waypoint)._replace(motion=motion))

    def steer(self, velocity: Vector, now_ns: int, yaw_rate: float | None = None) -> None:
        """Move the setpoint with `velocity` [m/s], world frame, from `now_ns` [ns] on.

        With a `yaw_rate` [rad/s] it also turns, from the robot's heading on, and `velocity` is in
        the frame of its heading. After a turn the setpoint rests ahead of the robot: one beside it
        would let a robot on wheels turn once more.
        """
        setpoint, seen = self.setpoint, self.seen
        assert setpoint is not None, "the setpoint is where the robot was held"
        assert seen is not None, "telemetry has shown the start"
        turned = self.is_driven and setpoint.turns
        if turned and not (any(velocity) or yaw_rate):
            x, y, z = map(add, seen.position, (COAST * speed for speed in seen.velocity))
            self.select_point(Leg((x, y, z)))
            return
        if yaw_rate is not None and not turned:
            yaw = -turn_to(0.0, seen.orientation_wxyz)
            setpoint = setpoint_at(setpoint, now_ns)._replace(yaw=yaw, motion=None)
        self.select(steer(setpoint, velocity, now_ns, self._fence, yaw_rate))

    def follow(self, began_ns: int, now_ns: int) -> None:
        """Move the setpoint from point to point of the track, which began at `began_ns` [ns]."""
        track = self._plan.track
        elapsed = (now_ns - began_ns) * 1e-9
        knot = bisect_right(track, elapsed, key=lambda each: each[0]) - 1
        if not self._knot < knot < len(track) - 1:
            return
        self._knot, (begin, start), (end, position) = knot, *track[knot : knot + 2]
        motion, lasts = None, end - begin
        if 0.0 < dist(start, position) <= JUMP_SPEED * lasts:
            x, y, z = ((b - a) / lasts for a, b in zip(start, position, strict=True))
            begin_ns, until_ns = (began_ns + round(at * 1e9) for at in (begin, end))
            box = self._fence.inner_low, self._fence.inner_high
            motion = Drive(start, begin_ns, (x, y, z), (x, y, z), ACCELERATION, until_ns, *box)
        self.select(Setpoint(position, waypoint=0, motion=motion))

    def leaves_ns(self, waypoint: int) -> int | None:
        """Return when the dwell time of the setpoint at a waypoint ends [ns].

        Return None if the present setpoint does not move gradually (`carrot`) to this waypoint.
        """
        setpoint = self.setpoint
        if setpoint is None or type(setpoint.motion) is not Motion or setpoint.waypoint != waypoint:
            return None
        return arrival_ns(setpoint) + round(self._plan.legs[waypoint].dwell * 1e9)

    def _setpoint_of(self, leg: Leg, waypoint: int) -> Setpoint:
        """Return the setpoint at a leg; without a yaw, it keeps the yaw of the setpoint before."""
        if leg.yaw is not None:
            return Setpoint(leg.position, leg.yaw, waypoint, turns=True)
        yaw = 0.0 if self.setpoint is None else self.setpoint.yaw
        return Setpoint(leg.position, yaw, waypoint)
