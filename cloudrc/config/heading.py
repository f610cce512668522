# SPDX-License-Identifier: Apache-2.0

"""The yaw of waypoints: not every robot obeys one."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Literal, TypeAlias

from cloudrc.config.problems import ConfigProblem
from cloudrc.config.schema import MissionConfig

Heading: TypeAlias = Literal["free", "fixed", "velocity"]
"""What decides about a robot's heading: the commanded yaw rate, nothing, or its velocity."""
WHY: dict[Heading, str] = {
    "fixed": "the onboard controller of this robot holds the yaw at 0",
    "velocity": "the heading of this robot follows its velocity",
}
"""Heading of a robot that does not obey a yaw -> why not."""


def check_yaws(mission: MissionConfig, heading: Heading) -> Iterator[ConfigProblem]:
    """Yield each yaw that the robot would not obey."""
    for index, waypoint in enumerate(mission.waypoints):
        yaw = waypoint.yaw_deg
        if yaw is not None and heading in WHY and (heading, yaw) != ("fixed", 0.0):
            reason = f"{WHY[heading]}; leave it out, or choose another robot, such as x2"
            yield ConfigProblem(("waypoints", str(index), "yaw_deg"), f"{yaw:g}", reason)


def without_held_yaws(mission: MissionConfig, heading: Heading) -> MissionConfig:
    """Return a mission without the yaws of 0 that a robot with a fixed heading holds anyway."""
    if heading != "fixed":
        return mission
    kept = {"yaw_deg": None, "yaw_tolerance_deg": None}
    waypoints = tuple(waypoint.model_copy(update=kept) for waypoint in mission.waypoints)
    return mission.model_copy(update={"waypoints": waypoints})
