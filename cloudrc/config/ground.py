# SPDX-License-Identifier: Apache-2.0

"""Missions of a robot that stays on the ground: its waypoints have the height of the spawn."""

from __future__ import annotations

from collections.abc import Iterator

from cloudrc.config.problems import ConfigProblem
from cloudrc.config.schema import GROUND, MissionConfig, Waypoint
from cloudrc.config.world import WorldFiles
from cloudrc.physics.geometry.scene import Scene

SAME = 1e-6
"""Largest difference from the height of the spawn [m]."""


def put_on_ground(mission: MissionConfig, files: WorldFiles) -> MissionConfig:
    """Return a mission in which waypoints of two numbers have the height of the spawn.

    A mission of a robot that flies stays as it is.
    """
    if not files.robot.planar:
        return mission
    placed, height = list[Waypoint](), files.scene.spawn[2]
    for waypoint in mission.waypoints:
        x, y, z = waypoint.position_m
        at = x, y, height if z == GROUND else z
        placed.append(waypoint.model_copy(update={"position_m": at}))
    return mission.model_copy(update={"waypoints": tuple(placed)})


def check_heights(mission: MissionConfig, scene: Scene) -> Iterator[ConfigProblem]:
    """Yield what leads a robot off the ground, with its path inside the mission."""
    steps, height = mission.steps, scene.spawn[2]
    ground = f"but the robot stays on the ground, at {height:g}"
    if steps is not None and (steps.range_m[2] or abs(steps.centre_m[2] - height) > SAME):
        yield ConfigProblem(("steps",), "", f"have heights, {ground}")
    for index, waypoint in enumerate(mission.waypoints):
        if abs(waypoint.position_m[2] - height) > SAME:
            path = ("waypoints", str(index), "position_m")
            shown = f"[{', '.join(f'{value:g}' for value in waypoint.position_m)}]"
            yield ConfigProblem(path, shown, f"has a height, {ground}; give two numbers, x and y")
            return
