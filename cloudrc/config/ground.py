"""Missions of a robot that stays on the ground: its waypoints have the height of the spawn."""

from __future__ import annotations

from collections.abc import Iterator

from cloudrc.config.problems import ConfigProblem
from cloudrc.config.schema import GROUND, MissionConfig
from cloudrc.geometry.scene import Scene
from cloudrc.messages import Vector

SAME = 1e-6
"""Largest difference from the height of the spawn [m]."""


def on_ground(position: Vector, scene: Scene) -> Vector:
    """Return a position [m], with the height of the spawn if it has none."""
    x, y, z = position
    return (x, y, scene.spawn[2] if z == GROUND else z)


def put_on_ground(mission: MissionConfig, scene: Scene) -> MissionConfig:
    """Return a mission in which waypoints of two numbers have the height of the spawn."""
    placed = tuple(
        waypoint.model_copy(update={"position_m": on_ground(waypoint.position_m, scene)})
        for waypoint in mission.waypoints
    )
    return mission.model_copy(update={"waypoints": placed})


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
