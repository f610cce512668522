# SPDX-License-Identifier: Apache-2.0

"""Convert the waypoints and the random steps of a mission to legs for teleop."""

from __future__ import annotations

from math import dist, inf, pi, radians

import numpy as np

from cloudrc.config import schema
from cloudrc.config.resolved import ResolvedGuard
from cloudrc.physics.geometry.fence import Fence
from cloudrc.teleop.wire import Leg

CRUISE_SPEED = 1.0
"""Expected speed between two waypoints, if the guard allows this speed [m/s]."""
TURN_RATE = 1.0
"""Expected yaw rate, if the guard allows it [rad/s]."""
SETTLE_TIME = 4.0
"""Expected extra time at the beginning and end of the way to a waypoint [s]."""
LEG_FACTOR = 3.0
"""Time limit for the way to a waypoint, as a multiple of the expected time.
Source: docs/reference/faults.md, "F28"."""


def leg_to(
    before: schema.Waypoint | None,
    waypoint: schema.Waypoint,
    fence: Fence,
    guard: ResolvedGuard,
    carrot: schema.Carrot | None,
) -> Leg:
    """Convert the waypoint at the end of a way."""
    speed_max, speed, acceleration = guard.speed_max_mps, 0.0, 1.0
    if carrot is not None:
        speed_max = speed = min(waypoint.speed_mps or carrot.speed_mps, speed_max)
        acceleration = carrot.acceleration_mps2
    limit = waypoint.time_limit_s
    if limit is None:
        # If the start of the way is unknown, assume the longest way.
        start, end = (before or waypoint).position_m, waypoint.position_m
        way = dist(fence.low, fence.high) if before is None else dist(start, end)
        expected = way / min(CRUISE_SPEED, speed_max) + SETTLE_TIME + waypoint.dwell_s
        if waypoint.yaw_deg is not None:
            expected += pi / min(TURN_RATE, guard.yaw_rate_max_radps)  # the longest turn
        limit = round(LEG_FACTOR * expected, 1)
    return Leg(
        waypoint.position_m,
        None if waypoint.yaw_deg is None else radians(waypoint.yaw_deg),
        waypoint.tolerance_m,
        waypoint.dwell_s,
        limit,
        speed,
        acceleration,
        waypoint.yaw_tolerance,
    )


def step_legs(steps: schema.Steps, rng: np.random.Generator) -> tuple[Leg, ...]:
    """Make random setpoints. Each lasts one period, even if the robot does not arrive."""
    offsets = rng.uniform(-1.0, 1.0, (steps.count, 3)) * steps.range_m + steps.centre_m
    limit = 10 * steps.period_s
    return tuple(
        Leg((x, y, z), tolerance=inf, dwell=steps.period_s, time_limit=limit)
        for x, y, z in offsets.tolist()
    )
