"""Compute where a moving setpoint, the carrot, is at any time.

The carrot moves straight to its end, with a trapezoid profile of the speed: it accelerates from
rest, moves at constant speed, and comes to rest at the end. The motion depends on time alone, so
that cloud and teleop agree on it, and cloud knows the future of the reference.
"""

from __future__ import annotations

from math import dist, sqrt

from cloudrc.messages import Setpoint

_new = tuple.__new__  # makes a named tuple twice as fast as its class does


def arrival_ns(setpoint: Setpoint) -> int:
    """Return when a setpoint comes to rest [ns]; 0 if it never moves."""
    if setpoint.motion is None:
        return 0
    _, _, total = _profile(setpoint)
    return setpoint.motion.begin_ns + round(total * 1e9)


def setpoint_at(setpoint: Setpoint, now_ns: int) -> Setpoint:
    """Return a setpoint with its position and velocity at `now_ns` [ns], cloud's clock."""
    motion = setpoint.motion
    if motion is None:
        return setpoint
    distance, ramp, total = _profile(setpoint)
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
    moved = (position, setpoint.yaw, setpoint.waypoint, setpoint.epoch, velocity, motion)
    return _new(Setpoint, moved)


def _profile(setpoint: Setpoint) -> tuple[float, float, float]:
    """Return the distance [m], the time of the acceleration [s] and the time in all [s]."""
    motion = setpoint.motion
    assert motion is not None, "the setpoint rests"
    distance, acceleration = dist(motion.start, setpoint.position), motion.acceleration
    ramp = min(motion.speed / acceleration, sqrt(distance / acceleration))
    return distance, ramp, distance / (acceleration * ramp) + ramp if ramp else 0.0
