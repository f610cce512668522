"""Check whether a mission can be flown in a scene.

Each waypoint must be inside the fence, the base's box and the arm must be clear of the pipes'
walls, and no straight way between waypoints may cross a wall. The board is not checked: the
paper's last waypoint is behind it. The rotors are not checked either: the metrics report how close
a flight comes.
"""

from __future__ import annotations

import numpy as np

from cloudrc.config.problems import Problem
from cloudrc.config.schema import MAX_WAYPOINTS, Mission, Steps
from cloudrc.geometry import fence
from cloudrc.geometry.placement import (
    find_crossed_pipe,
    find_nearest_legal,
    find_overlapped_pipe,
    outside_fence,
)
from cloudrc.geometry.robot import Array
from cloudrc.geometry.scene import Scene
from cloudrc.messages import Vector

_YAW = "the onboard controller holds yaw at 0, as the published one does; leave it out"
_REPORTED = 20
"""Largest number of problems of one kind that are listed."""


def check_mission(mission: Mission, scene: Scene) -> list[Problem]:
    """List the problems of a mission in a scene.

    Args:
        mission: Waypoints or steps.
        scene: The scene to fly in.

    Returns:
        Problems with paths relative to the mission; empty if it can be flown.
    """
    count = len(mission.waypoints)
    if mission.steps is not None:
        if count:
            reason = "a mission has waypoints or steps, not both; delete one"
            return [Problem(("steps",), "", reason)]
        return _check_steps(mission.steps, scene)
    if count == 0:
        return [Problem(("waypoints",), "", "none given; give at least one, or steps")]
    if count > MAX_WAYPOINTS:
        reason = f"must be at most {MAX_WAYPOINTS}; split the mission"
        return [Problem(("waypoints",), str(count), reason)]
    return _check_waypoints(mission, scene)


def _check_waypoints(mission: Mission, scene: Scene) -> list[Problem]:
    positions = np.array([waypoint.position_m for waypoint in mission.waypoints])
    yaws = np.radians([waypoint.yaw_deg for waypoint in mission.waypoints])
    outside = outside_fence(positions)
    hit = find_overlapped_pipe(scene, positions, yaws)
    wrong = np.flatnonzero(outside | (hit >= 0))
    problems = [
        Problem(("waypoints", str(index), "yaw_deg"), f"{mission.waypoints[index].yaw_deg:g}", _YAW)
        for index in np.flatnonzero(yaws)[:_REPORTED]
    ]
    for index in wrong[:_REPORTED]:
        point = mission.waypoints[index].position_m
        if outside[index]:
            reason = f"beyond the fence, {_fence_in_words()}"
        else:
            reason = f"base box or arm overlaps the wall of {scene.pipes[hit[index]].name}"
        near = find_nearest_legal(scene, point, float(yaws[index]))
        if near is not None:
            reason += f"; nearest legal point found: {_point(near)}"
        path = ("waypoints", str(index), "position_m")
        problems.append(Problem(path, _point(point), reason))
    if len(wrong) > _REPORTED:
        rest = f"{len(wrong) - _REPORTED} more waypoints are beyond the fence or in a pipe's wall"
        problems.append(Problem(("waypoints",), "", rest))
    return problems if len(wrong) else problems + _check_ways(positions, scene)


def _check_ways(positions: Array, scene: Scene) -> list[Problem]:
    """List the straight ways between waypoints [m], shape (n, 3), that cross a wall."""
    through = find_crossed_pipe(scene, positions[:-1], positions[1:])
    problems = []
    for index in np.flatnonzero(through >= 0)[:_REPORTED]:
        x, y, z = positions[index + 1].tolist()
        name = scene.pipes[through[index]].name
        reason = (
            f"the straight way there from waypoint {index} leads through the wall of {name}; "
            "add waypoints in between that lead around it or through the pipe"
        )
        path = ("waypoints", str(index + 1), "position_m")
        problems.append(Problem(path, _point((x, y, z)), reason))
    return problems


def _check_steps(steps: Steps, scene: Scene) -> list[Problem]:
    centre, reach = np.array(steps.centre_m), np.array(steps.range_m)
    axis = np.linspace(-1, 1, 9)
    box = np.stack(np.meshgrid(axis, axis, axis, indexing="ij"), axis=-1).reshape(-1, 3)
    with np.errstate(over="ignore"):  # infinity is beyond the fence
        positions = centre + box * reach
    if outside_fence(positions).any():
        reason = f"steps reach beyond the fence, {_fence_in_words()}; choose a smaller range_m"
        return [Problem(("steps",), "", reason)]
    hit = find_overlapped_pipe(scene, positions, np.zeros(len(positions)))
    if (hit >= 0).any():
        name = scene.pipes[hit.max()].name
        reason = f"steps can end in the wall of {name}; choose another centre_m, range_m or scene"
        return [Problem(("steps",), "", reason)]
    return []


def _fence_in_words() -> str:
    spans = (
        f"{name} {low:g} to {high:g}"
        for name, low, high in zip("xyz", fence.LOW, fence.HIGH, strict=True)
    )
    return f"{', '.join(spans)} [m]"


def _point(position: Vector) -> str:
    return f"[{', '.join(f'{value:g}' for value in position)}]"
