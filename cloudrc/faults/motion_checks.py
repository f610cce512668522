"""Check where the robot is, and which velocity it follows: invariants fence, cap, stop, rest."""

from __future__ import annotations

from math import hypot, inf, sqrt

from cloudrc.faults.watch import ESTOP, FLOWN, LAND, REELS_NS, TRACK, Watch
from cloudrc.messages import ZERO, GuardState, Vector
from cloudrc.sim.readings import Readings
from cloudrc.text import describe_point
from cloudrc.world.guard.state import Guard
from cloudrc.world.robot import STEP

SLACK = 1e-9  # tolerance for rounding [m/s]
STILL = 0.12
"""Largest speed of a robot at rest [m/s]: the guard's limit, 0.1, plus one step of free fall."""
REST = 0.5
"""Tolerance of the stopping distance after TRACK [m]; it includes a swing of up to 0.2 m."""
REACTION = 0.2  # time until the robot brakes as hard as it can [s]
MARGIN = 0.1  # distance from a face of the fence at which the robot has to stop [m]
FALL_MAX = 1.5  # largest distance that a falling robot may leave the fence [m]
THROWN_NS = 3_000_000_000  # time after a collision in which the robot may leave the fence [ns]


class MotionChecks:
    """Checks a robot's position and velocity reference in every step.

    Attributes:
        falls: Whether it was stopped or hit in the air, and has not flown since.
        before: The last reference [m/s].
    """

    def __init__(self, watch: Watch) -> None:
        self._watch, self._note = watch, watch.note
        self._stop_coefficient = 1.0 / (2.0 * watch.braking)
        self.before = ZERO
        self._left, self._way = ZERO, inf  # where TRACK ended, and how far the robot may go
        self.falls = False
        self._touched_ns = -THROWN_NS
        self._is_thrown = False  # by a collision, and not yet back inside the fence

    def touch(self) -> None:
        """Note a contact now: it may push the robot out of the fence."""
        self._touched_ns, self._way, self._is_thrown = self._watch.now_ns, inf, True

    def check_fence(
        self,
        was: GuardState,
        state: GuardState,
        readings: Readings,
    ) -> None:
        """Check that the base is inside the fence, or near it in a fall or after a collision.

        After an ESTOP in the air, the next take-off must begin at rest and inside the fence.
        """
        if was in FLOWN and state is ESTOP:
            self.falls = True
        if self.falls and state in FLOWN:
            self._check_take_off(readings)
        if readings.position[2] < self._watch.low[2]:
            text = f"base at {describe_point(readings.position)}, below the floor"
            self._note("fence", text)
        self._check_margin(readings.position)

    def _check_margin(self, position: Vector) -> None:
        """Check the distance of the base to the fence, and note the smallest."""
        margin = self._margin(position)
        if margin >= 0.0 and self._watch.now_ns - self._touched_ns >= THROWN_NS:
            self._is_thrown = False
        may_leave = self.falls or self._is_thrown
        if margin < (-FALL_MAX if may_leave else 0.0):
            how = "fell to" if may_leave else "at"
            self._note("fence", f"base {how} {describe_point(position)}")
        if not self.falls and (margin >= 0.0 or not self._is_thrown):
            self._watch.margin = min(self._watch.margin, margin)

    def _margin(self, position: Vector) -> float:
        """Return the distance to the nearest wall or the ceiling [m]; below 0 outside."""
        (x, y, z), (xl, yl, _), (xh, yh, zh) = position, self._watch.low, self._watch.high
        return min(x - xl, xh - x, y - yl, yh - y, zh - z)

    def _check_take_off(self, readings: Readings) -> None:
        """Check that a robot which fell is at rest inside the fence when it starts again."""
        self.falls = False
        at, speed = readings.position, hypot(*readings.velocity)
        if speed > STILL or self._margin(at) < 0.0 or at[2] < self._watch.low[2]:
            text = f"took off after a stop, base at {describe_point(at)} at {speed:.2f} m/s"
            self._note("fence", text)

    def check_reference(self, guard: Guard, position: Vector, ramped: bool) -> None:
        """Check the reference in TRACK, HOLD or LAND.

        `position` is that of the base [m], world frame. `ramped` tells that a HOLD has just ended.
        """
        reference, state = guard.reference, guard.state
        self._check_stop(position, reference, state is LAND)
        most = self._watch.limits.yaw_rate_max_radps
        if not abs(guard.yaw_rate) <= most:  # or it is NaN
            self._note("cap", f"reference turns by {guard.yaw_rate:.3f} rad/s")
        if reference is not self.before:
            self._check_caps(reference)
            if state is TRACK:  # braking is not limited: at the fence, or after a collision
                self._check_growth(reference, ramped)

    def _check_stop(self, position: Vector, reference: Vector, lands: bool) -> None:
        (x, y, z), (vx, vy, vz) = position, reference
        (xl, yl, zl), (xh, yh, zh) = self._watch.low, self._watch.high
        if not (
            self._can_stop(vx, x - xl, xh - x)
            and self._can_stop(vy, y - yl, yh - y)
            and (self._can_stop(vz, z - zl, zh - z) or (lands and vz < 0.0))
        ):
            text = f"reference ({vx:.3f}, {vy:.3f}, {vz:.3f}) m/s at {describe_point(position)}"
            self._note("stop", text)

    def _can_stop(self, speed: float, below: float, above: float) -> bool:
        """Return whether the robot can stop before the side of the fence that it moves towards.

        `speed` is the velocity along one axis [m/s]. `below` and `above` are the robot's distances
        to the two sides of the fence on this axis [m]. With the robot's braking a:
        0.2 v + v^2/(2a) <= distance - 0.1.
        Source: docs/reference/plant.md, "Stop rule".
        """
        distance = above if speed > 0.0 else below
        return speed == 0.0 or self._stop_distance(abs(speed)) <= distance - MARGIN + SLACK

    def _stop_distance(self, speed: float) -> float:
        """Return the way from `speed` [m/s] to rest [m]."""
        return speed * (REACTION + speed * self._stop_coefficient)

    def _check_caps(self, reference: Vector) -> None:
        vx, vy, vz = reference
        speed = sqrt(vx * vx + vy * vy + vz * vz)
        self._watch.speed = max(self._watch.speed, speed)
        if not speed <= self._watch.limits.speed_max_mps + SLACK:  # or it is NaN
            self._note("cap", f"reference {speed:.3f} m/s")
        if self._watch.planar and vz:
            self._note("cap", f"reference leaves the ground at {vz:.3f} m/s")

    def _check_growth(self, reference: Vector, ramped: bool) -> None:
        watch, grown = self._watch, growth(self.before, reference)
        most = watch.braking if ramped else watch.limits.acceleration_max_mps2
        if not grown <= most * STEP + SLACK:
            text = f"reference grows by {grown:.9f} m/s in a tick"
            self._note("cap", f"{text}{' after a HOLD' if ramped else ''}")

    def leave_track(self, readings: Readings) -> None:
        """Store where the robot is at the end of TRACK, and how far it may move from there."""
        speed = max(hypot(*readings.velocity), hypot(*self.before))
        self._left, self._way = readings.position, self._stop_distance(speed) + REST
        if self._watch.now_ns - self._touched_ns < REELS_NS:
            self._way = inf

    def check_rest(self, position: Vector) -> None:
        """Check after TRACK that the robot at `position` [m] is within its stopping distance."""
        dx, dy = position[0] - self._left[0], position[1] - self._left[1]
        if dx * dx + dy * dy > self._way * self._way:
            self._note("rest", f"{hypot(dx, dy):.2f} m from where the last command ended")


def growth(before: Vector, after: Vector) -> float:
    """Return how much a velocity grows from `before` to `after` [m/s].

    This is the norm of the growth per axis: the increase of the speed, or 0 if the speed falls.
    If the direction on an axis reverses, all of the new speed is growth.
    """
    (ux, uy, uz), (vx, vy, vz) = before, after
    return sqrt(_grown(ux, vx) ** 2 + _grown(uy, vy) ** 2 + _grown(uz, vz) ** 2)


def _grown(before: float, after: float) -> float:
    if before * after < 0.0:
        return abs(after)
    return max(abs(after) - abs(before), 0.0)
