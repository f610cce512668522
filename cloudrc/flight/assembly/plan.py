# SPDX-License-Identifier: Apache-2.0

"""Convert a mission to a plan for teleop, and an operator's order to a mission."""

from __future__ import annotations

from math import degrees, inf
from pathlib import Path
from typing import TYPE_CHECKING

from cloudrc.config import schema
from cloudrc.config.mission_check import start_of
from cloudrc.config.resolved import ResolvedExperiment
from cloudrc.config.setpoints import DRIVE_FILE, read_setpoints
from cloudrc.flight.assembly.draws import generator
from cloudrc.flight.assembly.legs import LEG_FACTOR, leg_to, step_legs
from cloudrc.teleop.wire import Leg, Plan
from cloudrc.wire.messages import Start

if TYPE_CHECKING:
    from cloudrc.teleop.store import Order

LIMIT_MIN = 60.0
"""Smallest time limit of a mission whose order gives none [s]."""
GRACE = 30.0
"""Time after the end of the mission's time limit at which a flight is stopped [s]."""


def flight_limit(experiment: ResolvedExperiment) -> float:
    """Return the time after which a flight is stopped [s]."""
    return build_plan(experiment).time_limit + GRACE


def build_plan(
    experiment: ResolvedExperiment,
    mission: schema.MissionConfig | None = None,
    time_limit: float | None = None,
) -> Plan:
    """Convert a valid mission, by default that of the experiment, to a plan for teleop.

    `time_limit` is that of another mission [s]; None: as long as the mission may need.
    """
    if mission is None:
        mission, time_limit = experiment.mission, experiment.criteria.time_limit_s
    fence = experiment.world.files.fence
    track = read_setpoints(Path(mission.setpoints), fence) if mission.setpoints else ()
    if (follow := mission.follow) is not None:
        place = start_of(follow, experiment.scene, planar=experiment.robot.planar)
        track = (0.0, place), (follow.duration_s, place)
    if track:
        legs: tuple[Leg, ...] = (Leg(track[0][1], tolerance=inf, time_limit=inf),)
        needed = LEG_FACTOR * track[-1][0]
    elif mission.steps is not None:
        legs = step_legs(mission.steps, generator(experiment.seed, "steps", experiment.stream))
        needed = LEG_FACTOR * mission.steps.count * mission.steps.period_s
    else:
        points = mission.waypoints
        legs = tuple(
            leg_to(before, waypoint, fence, experiment.guard, mission.carrot)
            for before, waypoint in zip((None, *points), points, strict=False)
        )
        needed = sum(leg.time_limit for leg in legs)
    start = Start.SPAWN if mission.start == "spawn" else Start.HERE
    limit = time_limit or max(LIMIT_MIN, needed)
    return Plan(legs, start, limit, track=track, judged_by=mission.judged_by, follow=follow)


def with_order(
    experiment: ResolvedExperiment, order: Order, description: str
) -> ResolvedExperiment:
    """Return the experiment with an operator's order as its mission, for report and repetition.

    If the order is a drive by hand, the mission reads its setpoints from the file `DRIVE_FILE`.
    """
    legs, carrot = order.plan.legs, None
    if speed := max(leg.speed for leg in legs):
        carrot = schema.Carrot(speed_mps=speed, acceleration_mps2=legs[0].acceleration)
    waypoints = tuple(
        schema.Waypoint(
            position_m=leg.position,
            yaw_deg=None if leg.yaw is None else round(degrees(leg.yaw), 9),
            yaw_tolerance_deg=None if leg.yaw is None else round(degrees(leg.yaw_tolerance), 9),
            tolerance_m=leg.tolerance,
            dwell_s=leg.dwell,
            time_limit_s=leg.time_limit,
            speed_mps=leg.speed or None,
        )
        for leg in ([] if order.plan.by_hand or order.plan.follow else legs)
    )
    mission = schema.MissionConfig(
        start="spawn" if order.plan.start is Start.SPAWN else "here",
        waypoints=waypoints,
        setpoints=DRIVE_FILE if order.plan.by_hand else None,
        follow=order.plan.follow,
        carrot=carrot,
        judged_by=order.plan.judged_by,
        touch=order.touch,
    )
    judged = {"time_limit_s": order.plan.time_limit}
    criteria = experiment.criteria.model_copy(update=judged)
    changed = {"mission": mission, "criteria": criteria, "description": description}
    return experiment.model_copy(update=changed)
