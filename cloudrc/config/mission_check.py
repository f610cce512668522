"""Check whether a mission can be flown in a scene.

Each waypoint must be where the guard lets the robot fly. At each waypoint and on the straight ways
between them, the way from the spawn included, the whole robot must be clear of the pipes' walls.
The board is not checked: the paper's last waypoint is behind the board.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from cloudrc.config.problems import Problem
from cloudrc.config.schema import MAX_WAYPOINTS, Mission, Steps
from cloudrc.geometry import fence
from cloudrc.geometry.clearance import Array
from cloudrc.geometry.placement import (
    CLEARANCE_MIN,
    find_crossed_pipe,
    find_nearest_legal,
    find_overlapped_pipe,
    outside_fence,
)
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
        Problems with paths relative to the mission; empty if the mission can be flown.
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
    # A waypoint counts as reached within its tolerance; half of it is left for the flight's errors.
    slack = np.array([0.5 * waypoint.tolerance_m for waypoint in mission.waypoints])
    outside = outside_fence(positions, slack) | ~_in_fence(positions)
    hit = find_overlapped_pipe(scene, positions, yaws)
    wrong = np.flatnonzero(outside | (hit >= 0))
    problems = [
        Problem(("waypoints", str(index), "yaw_deg"), f"{mission.waypoints[index].yaw_deg:g}", _YAW)
        for index in np.flatnonzero(yaws)[:_REPORTED]
    ]
    for index in wrong[:_REPORTED]:
        point = mission.waypoints[index].position_m
        if outside[index]:
            reason = f"beyond the fence, or nearer than the guard flies: {_fence_in_words()}"
        else:
            name = scene.pipes[hit[index]].name
            reason = f"the robot would be within {CLEARANCE_MIN:g} m of the wall of {name}"
        before = mission.waypoints[index - 1].position_m if index else None
        if index == 0 and mission.start == "spawn":
            before = scene.spawn
        before = None if index - 1 in wrong else before
        near = find_nearest_legal(scene, point, float(yaws[index]), before)
        if near is not None:
            reason += f"; nearest legal point found: {_point(near)}"
        path = ("waypoints", str(index), "position_m")
        problems.append(Problem(path, _point(point), reason))
    if len(wrong) > _REPORTED:
        rest = f"{len(wrong) - _REPORTED} more waypoints are beyond the fence or at a pipe's wall"
        problems.append(Problem(("waypoints",), "", rest))
    if len(wrong):
        return problems
    starts = [scene.spawn] if mission.start == "spawn" else [mission.waypoints[0].position_m]
    return problems + _check_ways(np.concatenate([starts, positions]), scene)


def _in_fence(positions: Array) -> NDArray[np.bool_]:
    inside: NDArray[np.bool_] = np.all((positions >= fence.LOW) & (positions <= fence.HIGH), axis=1)
    return inside


def _check_ways(positions: Array, scene: Scene) -> list[Problem]:
    """List the straight ways that lead into a wall.

    `positions` are the start and the waypoints [m], world frame, shape (n, 3).
    """
    through = find_crossed_pipe(scene, positions[:-1], positions[1:])
    problems = []
    for index in np.flatnonzero(through >= 0)[:_REPORTED]:
        x, y, z = positions[index + 1].tolist()
        name = scene.pipes[through[index]].name
        start = f"waypoint {index - 1}" if index else "the spawn"
        reason = (
            f"the straight way there from {start} leads through the wall of {name}, or within "
            f"{CLEARANCE_MIN:g} m of it; add waypoints in between that lead around it or through "
            "the pipe"
        )
        path = ("waypoints", str(index), "position_m")
        problems.append(Problem(path, _point((x, y, z)), reason))
    return problems


def _check_steps(steps: Steps, scene: Scene) -> list[Problem]:
    centre, reach = np.array(steps.centre_m), np.array(steps.range_m)
    axis = np.linspace(-1, 1, 9)
    box = np.stack(np.meshgrid(axis, axis, axis, indexing="ij"), axis=-1).reshape(-1, 3)
    with np.errstate(over="ignore"):  # infinity is beyond the fence
        positions = centre + box * reach
    if outside_fence(positions).any():
        reason = (
            "steps reach beyond the fence, or nearer to it than the guard flies: "
            f"{_fence_in_words()}; choose a smaller range_m"
        )
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
        for name, low, high in zip("xyz", fence.INNER_LOW, fence.INNER_HIGH, strict=True)
    )
    return f"{', '.join(spans)} [m]"


def _point(position: Vector) -> str:
    return f"[{', '.join(f'{value:g}' for value in position)}]"
