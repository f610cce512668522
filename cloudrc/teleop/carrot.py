# SPDX-License-Identifier: Apache-2.0

"""Compute where a moving setpoint, the carrot, is at any time.

The carrot moves in a straight line to a waypoint with a trapezoidal speed profile: it accelerates
from rest, moves at constant speed, and brakes to rest at the waypoint. The motion depends on time
alone: teleop and cloud compute the same motion, and cloud can compute future setpoints.

A setpoint that is driven by hand moves with the velocity of the operator's last request. If no
other request follows, the setpoint brakes to rest, even if teleop has ended.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from math import cos, dist, sin, sqrt

from cloudrc.physics.geometry.fence import Fence
from cloudrc.wire.messages import ZERO, Drive, Motion, Setpoint, Vector

HEARTBEAT_NS = 500_000_000
"""Time from the last request to drive until the setpoint begins to brake [ns]."""
SPEED_MAX, ACCELERATION = 1.5, 2.0
"""Largest speed [m/s] and acceleration [m/s^2] of a setpoint that is driven by hand. The guard
limits the acceleration of the robot to 3 m/s^2."""
TURN_MAX = 1.0
"""Largest yaw rate of such a setpoint [rad/s]: what the guard allows by default."""
_new = tuple.__new__  # makes a named tuple in half the time of a call of its class


def arrival_ns(setpoint: Setpoint) -> int:
    """Return when a setpoint comes to rest [ns], cloud's clock; 0 if it does not move."""
    if setpoint.motion is None:
        return 0
    _, _, total = _profile(setpoint)
    return setpoint.motion.begin_ns + round(total * 1e9)


def setpoint_at(setpoint: Setpoint, now_ns: int) -> Setpoint:
    """Return the setpoint with its position and velocity at `now_ns` [ns], cloud's clock."""
    return setpoint if setpoint.motion is None else path_of(setpoint)(now_ns)


def path_of(setpoint: Setpoint) -> Callable[[int], Setpoint]:
    """Return `setpoint_at` for this setpoint: a function of the time [ns], cloud's clock.

    It takes less time if the setpoint is needed for many instants.
    """
    motion = setpoint.motion
    if motion is None:
        return lambda now_ns: setpoint
    if type(motion) is Drive:
        return partial(_driven, setpoint, motion)
    return partial(_moved, setpoint, *_profile(setpoint))


def _moved(setpoint: Setpoint, distance: float, ramp: float, total: float, now_ns: int) -> Setpoint:
    """Return a setpoint with a `Motion` at `now_ns`; the times and distance are its `_profile`."""
    motion = setpoint.motion
    assert isinstance(motion, Motion), "the setpoint rests, or is driven"
    since, acceleration = (now_ns - motion.begin_ns) * 1e-9, motion.acceleration
    if since >= total or not distance:
        return setpoint
    if since <= 0.0:
        way, speed = 0.0, 0.0
    elif since < ramp:
        way, speed = 0.5 * acceleration * since * since, acceleration * since
    elif since <= total - ramp:
        speed = acceleration * ramp
        way = speed * (since - 0.5 * ramp)
    else:
        left = total - since
        way, speed = distance - 0.5 * acceleration * left * left, acceleration * left
    (ax, ay, az), (bx, by, bz) = motion.start, setpoint.position
    x, y, z = (bx - ax) / distance, (by - ay) / distance, (bz - az) / distance
    position = (ax + way * x, ay + way * y, az + way * z)
    velocity = (speed * x, speed * y, speed * z)
    _, yaw, waypoint, epoch, _, _, turns, _ = setpoint
    return _new(Setpoint, (position, yaw, waypoint, epoch, velocity, motion, turns, 0.0))


def _profile(setpoint: Setpoint) -> tuple[float, float, float]:
    """Return distance [m], acceleration time [s] and total time [s] of a setpoint's motion."""
    motion = setpoint.motion
    assert isinstance(motion, Motion), "the setpoint rests, or is driven"
    distance, acceleration = dist(motion.start, setpoint.position), motion.acceleration
    ramp = min(motion.speed / acceleration, sqrt(distance / acceleration))
    return distance, ramp, distance / (acceleration * ramp) + ramp if ramp else 0.0


def steer(
    setpoint: Setpoint, velocity: Vector, now_ns: int, fence: Fence, yaw_rate: float | None = None
) -> Setpoint:
    """Return a setpoint that moves with `velocity` [m/s], world frame, from `now_ns` [ns] on.

    It begins where `setpoint` is at `now_ns`. It stays in the box in which the guard lets the robot
    fly inside `fence`, and slows down before a wall.

    With a `yaw_rate` [rad/s] it also turns from the heading of `setpoint`, and `velocity` is in the
    frame of this heading: x ahead, y to the left.
    """
    start, yaw, _, _, before, *_ = setpoint_at(setpoint, now_ns)
    if yaw_rate is not None:
        u, v, w = velocity
        velocity = u * cos(yaw) - v * sin(yaw), u * sin(yaw) + v * cos(yaw), w
    low, high = fence.inner_low, fence.inner_high
    x, y, z = (
        max(-_speed_within(at - below), min(asked, _speed_within(above - at)))
        for asked, at, below, above in zip(velocity, start, low, high, strict=True)
    )
    until_ns = now_ns + HEARTBEAT_NS
    turn = yaw_rate or 0.0
    motion = Drive(start, now_ns, before, (x, y, z), ACCELERATION, until_ns, low, high, turn)
    moving = Setpoint(start, yaw, motion=motion, turns=yaw_rate is not None)
    return moving._replace(position=setpoint_at(moving, now_ns + 4 * HEARTBEAT_NS).position)


def _speed_within(distance: float) -> float:
    """Return the largest speed [m/s] from which a setpoint stops within `distance` [m].

    The distance is that after the operator's last request: the setpoint keeps its speed for
    HEARTBEAT_NS, then brakes.
    """
    wait = HEARTBEAT_NS * 1e-9
    return ACCELERATION * (sqrt(wait * wait + 2.0 * max(distance, 0.0) / ACCELERATION) - wait)


def _driven(setpoint: Setpoint, drive: Drive, now_ns: int) -> Setpoint:
    start, begin_ns, before, target, acceleration, until_ns, lowest, highest, yaw_rate = drive
    time = max(min(now_ns, until_ns) - begin_ns, 0) * 1e-9
    position, velocity = _change(start, before, target, acceleration, time)
    yaw = setpoint.yaw + yaw_rate * time
    if now_ns > until_ns:
        time, yaw_rate = (now_ns - until_ns) * 1e-9, 0.0
        position, velocity = _change(position, velocity, ZERO, acceleration, time)
    sides = zip(position, lowest, highest, strict=True)
    x, y, z = inside = tuple(max(low, min(at, high)) for at, low, high in sides)
    u, v, w = (s if a == b else 0.0 for s, a, b in zip(velocity, position, inside, strict=True))
    place, moves = (x, y, z), (u, v, w)
    return setpoint._replace(position=place, velocity=moves, yaw=yaw, yaw_rate=yaw_rate)


def _change(
    position: Vector, before: Vector, after: Vector, acceleration: float, time: float
) -> tuple[Vector, Vector]:
    """Return position [m] and velocity [m/s], `time` [s] after a change of velocity has begun.

    The velocity changes from `before` to `after` at a constant acceleration [m/s^2]; then it stays
    constant. `position` is the position at the beginning of the change [m].
    """
    ramp = dist(before, after) / acceleration
    share = min(time / ramp, 1.0) if ramp else 1.0
    rising, steady = min(time, ramp), max(time - ramp, 0.0)
    u, v, w = (a + share * (b - a) for a, b in zip(before, after, strict=True))
    x, y, z = (
        at + 0.5 * (a + now) * rising + b * steady
        for at, a, now, b in zip(position, before, (u, v, w), after, strict=True)
    )
    return (x, y, z), (u, v, w)
