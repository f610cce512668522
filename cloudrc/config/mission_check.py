# SPDX-License-Identifier: Apache-2.0

"""Check whether the robot can fly a mission in a scene.

Each waypoint must be in the region in which the guard lets the robot fly. The robot must keep a
distance from the obstacles at each waypoint, and on the straight path to the waypoint from the
spawn point or from the previous waypoint. The body that the mission has to touch may be on this
path, as in the paper's mission.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from itertools import islice
from pathlib import Path

import numpy as np

from cloudrc.base.text import unknown_name_text
from cloudrc.config.follow import Follow
from cloudrc.config.ground import check_heights
from cloudrc.config.heading import check_yaws
from cloudrc.config.problems import ConfigProblem, collect
from cloudrc.config.robot import RobotFiles
from cloudrc.config.schema import MissionConfig, Steps
from cloudrc.config.setpoints import read_setpoints
from cloudrc.config.world import WorldFiles
from cloudrc.physics.geometry.clearance import Array, Spheres
from cloudrc.physics.geometry.fence import Fence
from cloudrc.physics.geometry.obstacles import obstacles, surface
from cloudrc.physics.geometry.placement import (
    CLEARANCE_MIN,
    find_crossed,
    find_overlapped,
    outside_fence,
)
from cloudrc.physics.geometry.scene import FLOOR, Scene
from cloudrc.wire.messages import Vector

_REPORTED = 20
"""Largest number of problems of one kind in an error message."""
TOUCHING = 1e-3
"""Distance from an obstacle below which the robot touches it [m]; it covers rounding errors."""


def check_scene(files: WorldFiles, touch: str | None) -> list[ConfigProblem]:
    """List the problems of a scene for a mission that has to touch the body `touch`.

    Their paths are those of the experiment.
    """
    scene, robot, fence = files.scene, files.hull, files.fence
    spawn = np.array([scene.spawn])
    low, high = (*fence.inner_low[:2], fence.low[2]), fence.inner_high  # it stands on the ground
    spawn_at = _point(scene.spawn)
    if (np.clip(spawn, low, high) != spawn)[0, fence.axes].any():
        where = _spans(low, high, fence.axes)
        reason = f"the spawn, {spawn_at}, is outside or too near to a wall; it may be at {where}"
        return [ConfigProblem(("world", "fence_m"), "", reason)]
    known = obstacles(scene, touch=touch)
    (hit,) = find_overlapped(known, robot, spawn, TOUCHING)
    if hit < 0:
        return []
    reason = (
        f"at the spawn, {spawn_at}, the robot touches {surface(known[hit])}; every body but floor "
        "is an obstacle"
    )
    return [ConfigProblem(("world", "scene"), scene.name, reason)]


def check_mission(
    mission: MissionConfig, files: WorldFiles, *, straight: bool = True
) -> list[ConfigProblem]:
    """List the problems of a mission for a robot in its scene, with paths inside the mission.

    Without `straight`, the robot finds its ways by itself, so that only waypoints are judged.
    """
    scene, robot = files.scene, files.robot
    if problem := _check_parts(mission) or _check_touch(mission, scene):
        return [problem]
    problems = [*check_heights(mission, scene)] if robot.planar else []
    problems += islice(check_yaws(mission, robot.heading), _REPORTED)
    if problems:
        return problems
    fence, hull = files.fence, files.hull
    if mission.follow is not None:
        return [*_check_follow(mission.follow, robot, scene, fence)]
    if mission.setpoints is not None:
        with collect(problems, ("setpoints",)):
            read_setpoints(Path(mission.setpoints), fence)
        return problems
    if mission.steps is not None:
        reason = _check_steps(mission, mission.steps, scene, hull, fence)
        return [ConfigProblem(("steps",), "", reason)] if reason else []
    return list(
        _check_fence(mission, fence) or _check_ways(mission, scene, hull, straight=straight)
    )


def _check_parts(mission: MissionConfig) -> ConfigProblem | None:
    """Return the first problem of parts that exclude or need each other."""
    kinds = "waypoints", "steps", "setpoints", "follow"
    given = [key for key in kinds if getattr(mission, key)]
    if len(given) != 1:
        what = f"not both: {' and '.join(given)}" if given else "none given"
        reason = f"{what}; give waypoints, or steps, or setpoints, or follow"
        return ConfigProblem(("waypoints",), "", reason)
    if mission.carrot is not None and not mission.waypoints:
        return ConfigProblem(("carrot",), "", f"needs waypoints, but there are {given[0]}")
    for index, waypoint in enumerate(mission.waypoints):
        if mission.carrot is None and waypoint.speed_mps is not None:
            path = ("waypoints", str(index), "speed_mps")
            return ConfigProblem(path, f"{waypoint.speed_mps:g}", "needs the key carrot")
    return None


def _check_touch(mission: MissionConfig, scene: Scene) -> ConfigProblem | None:
    """Return the problem of a mission's touch, if it has one."""
    body = mission.touched
    if body is None:
        return None
    if mission.steps is not None:
        return ConfigProblem(("touch",), "", "random steps lead to no body; set it to null")
    known = [name for name in scene.bodies if name not in (FLOOR, *scene.intangible)]
    is_complete = scene.path is None or body in scene.bodies
    if body in known or not is_complete:
        return None
    text = unknown_name_text(f"body of the scene {scene.name}", body, known)
    return ConfigProblem(("touch", "body"), body, f"{text}; null: nothing to touch")


def _check_follow(
    follow: Follow, robot: RobotFiles, scene: Scene, fence: Fence
) -> Iterator[ConfigProblem]:
    """Yield why a robot cannot keep a body in view."""
    known = [each.name for each in scene.moving]
    if follow.target not in known:
        reason = unknown_name_text(f"moving body of the scene {scene.name}", follow.target, known)
        yield ConfigProblem(("follow", "target"), follow.target, reason)
    elif scene.path is None and follow.target not in scene.intangible:
        reason = 'it would push the robot: give its geoms contype="0" and conaffinity="0"'
        yield ConfigProblem(("follow", "target"), follow.target, reason)
    if robot.camera is None:
        reason = "the robot has no camera: choose x2, or give its robot.yaml the key camera"
        yield ConfigProblem(("follow",), "", reason)
    place = np.array([start_of(follow, scene, planar=robot.planar)])
    if outside_fence(fence, place).any():
        reason = f"beyond the fence, or too near to it; {_allowed(fence)}"
        yield ConfigProblem(("follow", "height_m"), f"{follow.height_m:g}", reason)


def start_of(follow: Follow, scene: Scene, *, planar: bool) -> Vector:
    """Return where a robot waits that keeps a body in view, until it knows where to go [m]."""
    x, y, z = scene.spawn
    return x, y, z if planar else z + follow.height_m


def _check_fence(mission: MissionConfig, fence: Fence) -> list[ConfigProblem]:
    """List the waypoints beyond the fence.

    A waypoint may be outside by half its tolerance; the other half is for control errors.
    """
    positions = _positions(mission)
    slack = np.array([0.5 * waypoint.tolerance_m for waypoint in mission.waypoints])
    reason = f"beyond the fence, or too near to it; {_allowed(fence)}"
    outside = np.flatnonzero(outside_fence(fence, positions, slack)).tolist()
    return [_at_point(index, positions[index], reason) for index in outside[:_REPORTED]]


def _check_ways(
    mission: MissionConfig, scene: Scene, robot: Spheres, *, straight: bool
) -> Iterator[ConfigProblem]:
    """Yield the waypoints that are, or to which the `straight` way leads, near to an obstacle."""
    known, positions = obstacles(scene, touch=mission.touched), _positions(mission)
    hit = find_overlapped(known, robot, positions)
    for index in np.flatnonzero(hit >= 0)[:_REPORTED]:
        reason = f"the robot would be within {CLEARANCE_MIN:g} m of {surface(known[hit[index]])}"
        yield _at_point(index, positions[index], reason)
    if (hit >= 0).any() or not straight:
        return
    through = find_crossed(known, robot, _starts(mission, scene), positions)
    for index in np.flatnonzero(through >= 0)[:_REPORTED]:
        before = f"waypoint {index - 1}" if index else "the spawn"
        reason = (
            f"the straight way there from {before} leads through {surface(known[through[index]])}, "
            f"or within {CLEARANCE_MIN:g} m of it; add waypoints in between that lead around it"
        )
        yield _at_point(index, positions[index], reason)


def _positions(mission: MissionConfig) -> Array:
    """Return the positions of the n waypoints [m], shape (n, 3)."""
    return np.array([waypoint.position_m for waypoint in mission.waypoints])


def _starts(mission: MissionConfig, scene: Scene) -> Array:
    """Return where the ways to the n waypoints begin [m], shape (n, 3)."""
    positions = _positions(mission)
    return np.vstack([scene.spawn if mission.start == "spawn" else positions[0], positions[:-1]])


def _check_steps(
    mission: MissionConfig, steps: Steps, scene: Scene, robot: Spheres, fence: Fence
) -> str:
    """Check the box that contains all random setpoints; return the problem, "" if none."""
    axis = np.linspace(-1, 1, 9)
    box = np.stack(np.meshgrid(axis, axis, axis, indexing="ij"), axis=-1).reshape(-1, 3)
    with np.errstate(over="ignore"):  # an infinite position is outside the fence, too
        positions = np.array(steps.centre_m) + box * np.array(steps.range_m)
    if outside_fence(fence, positions).any():
        where = _allowed(fence)
        return f"steps reach beyond the fence, or too near to it; {where}; choose a smaller range_m"
    known = obstacles(scene, touch=mission.touched)
    hit = find_overlapped(known, robot, positions).max()
    if hit >= 0:
        where = surface(known[hit])
        return f"steps can end in {where}; choose another centre_m, range_m or scene"
    return ""


def _allowed(fence: Fence) -> str:
    """Describe where the guard lets the robot be, world frame."""
    return (
        f"the guard keeps the robot within {_spans(fence.inner_low, fence.inner_high, fence.axes)}"
    )


def _spans(low: Vector, high: Vector, axes: slice) -> str:
    """Describe a box by its corners [m], along some axes."""
    sides = zip("xyz", low, high, strict=True)
    spans = [f"{axis} {below:g} to {above:g}" for axis, below, above in sides]
    return f"{', '.join(spans[axes])} [m]"


def _at_point(index: int, position: Array, reason: str) -> ConfigProblem:
    return ConfigProblem(("waypoints", str(index), "position_m"), _point(position), reason)


def _point(position: Iterable[float]) -> str:
    return f"[{', '.join(f'{value:g}' for value in position)}]"
