"""Check whether the robot can fly a mission in a scene.

Each waypoint must be in the region in which the guard lets the robot fly. The robot must keep a
distance from the obstacles at each waypoint, and on the straight path to the waypoint from the
spawn point or from the previous waypoint. The body that the mission has to touch may be on this
path, as in the paper's mission.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
from difflib import get_close_matches
from itertools import islice
from math import radians
from pathlib import Path
from typing import NamedTuple

import numpy as np

from cloudrc.config.ground import check_heights
from cloudrc.config.heading import Heading, check_yaws
from cloudrc.config.problems import ConfigProblem
from cloudrc.config.schema import GROUND, MissionConfig, Steps
from cloudrc.config.setpoints import read_setpoints
from cloudrc.errors import BadInputError
from cloudrc.geometry.clearance import Array, Spheres
from cloudrc.geometry.fence import HEIGHT_MIN, WIDTH_MIN, Fence
from cloudrc.geometry.obstacles import (
    Obstacle,
    bodies_inside,
    body_names,
    fence_of,
    intangible,
    obstacles,
    surface,
)
from cloudrc.geometry.placement import (
    CLEARANCE_MIN,
    find_crossed,
    find_overlapped,
    outside_fence,
)
from cloudrc.geometry.scene import FLOOR, Scene, Tube
from cloudrc.messages import Vector

FLIES = "a robot that flies needs a height: give three numbers, x, y and z"
UNREACHED = "no waypoint brings the robot to it: they are for a longer robot, or too far away"
"""Reason of the problem of a body to touch that the robot does not reach."""
_REPORTED = 20
"""Largest number of problems of one kind in an error message."""
TOUCHING = 1e-3
"""Distance from an obstacle below which the robot touches it [m]; it covers rounding errors."""


class _Place(NamedTuple):
    """What a mission has to keep away from, and the robot that flies it."""

    known: Sequence[Obstacle]
    robot: Spheres  # dense
    fence: Fence
    planar: bool


def check_scene(
    scene: Scene, robot: Spheres, *, touch: str | None, planar: bool = False
) -> list[ConfigProblem]:
    """List the problems of a scene for a mission that has to touch the body `touch`.

    Their paths are those of the experiment. The `robot` is given as dense spheres. A `planar` robot
    stays on the ground.
    """
    if problem := _check_fence(scene, planar=planar):
        return [problem]
    known, spawn = obstacles(scene, touch=touch), np.array([scene.spawn])
    (hit,) = find_overlapped(known, robot, spawn, np.zeros(1), TOUCHING)
    if hit < 0:
        return []
    reason = (
        f"at the spawn, {_point(spawn[0])}, the robot touches {surface(known[hit])}; every body "
        "but floor is an obstacle: move the spawn, or put what the robot stands on into body floor"
    )
    return [ConfigProblem(("world", "scene"), scene.name, reason)]


def _check_fence(scene: Scene, *, planar: bool) -> ConfigProblem | None:
    """Return the problem of a fence in which the robot cannot take off or drive."""
    fence, path = fence_of(scene), ("world", "fence_m")
    size = [high - low for low, high in zip(fence.low, fence.high, strict=True)]
    if min(size[:2]) < WIDTH_MIN or (size[2] < HEIGHT_MIN and not planar):
        given = " x ".join(f"{length:g}" for length in size[: 2 if planar else 3])
        needs = f"{WIDTH_MIN:g} m wide" + ("" if planar else f" and {HEIGHT_MIN:g} m high")
        verb = "drive" if planar else "take off"
        reason = f"too small for the robot to {verb}; make it at least {needs}"
        return ConfigProblem(path, f"{given} m", reason)
    low, high = (*fence.inner_low[:2], fence.low[2]), fence.inner_high  # it stands on the ground
    stands = zip(low, scene.spawn, high, strict=True)
    inside = [below <= at <= above for below, at, above in stands]
    if all(inside[: 2 if planar else 3]):
        return None
    reason = (
        f"the spawn, {_point(np.array(scene.spawn))}, is outside or too near to a wall; it may be "
        f"at {_spans(low, high, planar=planar)}; move the spawn or the fence"
    )
    return ConfigProblem(
        path, f"[{_point(np.array(fence.low))}, {_point(np.array(fence.high))}]", reason
    )


def _check_touch(mission: MissionConfig, scene: Scene) -> ConfigProblem | None:
    """Return the problem of a mission's touch, if it has one."""
    body, names = mission.touched, body_names(scene)
    if body is None:
        return None
    if mission.steps is not None:
        return ConfigProblem(
            ("touch",), "", "random steps lead to no body; set mission.touch to null"
        )
    if body == FLOOR:
        reason = "the robot stands on it; name another body, or set mission.touch to null"
    elif body in intangible(scene):
        give = "give its geoms contype and conaffinity 1, or name another body"
        reason = f"the robot flies through it; {give}"
    elif names is None or body in names:
        return None
    else:
        others = [name for name in names if name != FLOOR]
        near = get_close_matches(body, others, 1)
        has = ", ".join(others[:_REPORTED]) or "none but floor"
        known = f"the nearest name is {near[0]}" if near else f"its bodies: {has}"
        reason = f"the scene {scene.name} has no such body; {known}; or set mission.touch to null"
        if inside := bodies_inside(scene, body):
            parts = ", ".join(inside[:_REPORTED])
            reason = f"it has no geom of its own; name a body inside of it: {parts}"
    return ConfigProblem(("touch", "body"), body, reason)


def check_mission(
    mission: MissionConfig,
    scene: Scene,
    robot: Spheres,
    *,
    planar: bool = False,
    heading: Heading = "free",
) -> list[ConfigProblem]:
    """List the problems of a mission in a scene, each with its path inside the mission.

    The `robot` is given as dense spheres. A `planar` robot stays on the ground, at the height of
    the spawn. `heading` says whether the robot obeys a yaw.
    """
    if problem := _check_parts(mission) or _check_touch(mission, scene):
        return [problem]
    if planar and (problems := check_heights(mission, scene)):
        return problems
    fence = fence_of(scene)
    if mission.setpoints is not None:
        steered = replace(fence, ground=scene.spawn[2]) if planar else fence
        return _check_setpoints(Path(mission.setpoints), steered)
    if problems := list(islice(check_yaws(mission, heading), _REPORTED)):
        return problems
    place = _Place(obstacles(scene, touch=mission.touched), robot, fence, planar)
    if mission.steps is not None:
        reason = _check_steps(mission.steps, place)
        return [ConfigProblem(("steps",), "", reason)] if reason else []
    start = scene.spawn if mission.start == "spawn" else None
    return list(_check_waypoints(mission, place, start))


def _check_setpoints(path: Path, fence: Fence) -> list[ConfigProblem]:
    try:
        read_setpoints(path, fence)
    except BadInputError as error:
        return [ConfigProblem(("setpoints",), "", str(error))]
    return []


def _check_parts(mission: MissionConfig) -> ConfigProblem | None:
    """Return the first problem of parts that exclude or need each other."""
    if mission.setpoints is not None:
        if mission.waypoints or mission.steps or mission.carrot:
            reason = "a mission has setpoints, or waypoints, steps and a carrot; delete one"
            return ConfigProblem(("setpoints",), "", reason)
        return None
    if problem := _check_carrot(mission):
        return problem
    if mission.steps is not None and mission.waypoints:
        reason = "a mission has waypoints or steps, not both; delete one"
        return ConfigProblem(("steps",), "", reason)
    if mission.steps is None and not mission.waypoints:
        reason = "none given; give at least one, or steps or setpoints"
        return ConfigProblem(("waypoints",), "", reason)
    return None


def _check_carrot(mission: MissionConfig) -> ConfigProblem | None:
    """Return the problem of a carrot with steps, or of its speed without a carrot."""
    if mission.carrot is not None:
        if mission.steps is None:
            return None
        return ConfigProblem(("carrot",), "", "impossible with steps; delete it, or give waypoints")
    for index, waypoint in enumerate(mission.waypoints):
        if waypoint.speed_mps is not None:
            reason = "is the speed of a carrot; give the mission a carrot, or delete it"
            path = ("waypoints", str(index), "speed_mps")
            return ConfigProblem(path, f"{waypoint.speed_mps:g}", reason)
    return None


def _check_waypoints(
    mission: MissionConfig, place: _Place, start: Vector | None
) -> Iterator[ConfigProblem]:
    known, robot, fence, planar = place
    positions = np.array([waypoint.position_m for waypoint in mission.waypoints])
    yaws = _yaws(mission)
    # A waypoint may be outside by half its tolerance; the other half is for control errors.
    slack = np.array([0.5 * waypoint.tolerance_m for waypoint in mission.waypoints])
    outside = outside_fence(fence, positions, slack, planar=planar)
    hit = find_overlapped(known, robot, positions, yaws[1:])
    wrong = np.flatnonzero(outside | (hit >= 0))
    for index in wrong[:_REPORTED]:
        position = mission.waypoints[index].position_m
        if outside[index]:
            needs_height = position[2] == GROUND and not planar
            what = FLIES if needs_height else "beyond the fence, or too near to it"
            reason = f"{what}; {_allowed(fence, planar=planar)}"
        else:
            reason = (
                f"the robot would be within {CLEARANCE_MIN:g} m of {surface(known[hit[index]])}"
            )
        yield _at_point(index, positions[index], reason)
    if not len(wrong):
        yield from _check_ways(np.vstack([start or positions[0], positions]), yaws, place)


def check_reach(mission: MissionConfig, scene: Scene, robot: Spheres) -> list[ConfigProblem]:
    """List the problem of a body to touch that the `robot` reaches on no way to a waypoint.

    It must touch the body `CLEARANCE_MIN` before the end of a way: a controller may end so far off.
    """
    body = [each for each in obstacles(scene, touch=None) if each.name == mission.touched]
    if not body or not mission.waypoints:
        return []
    points = np.array([waypoint.position_m for waypoint in mission.waypoints])
    starts = np.vstack([scene.spawn if mission.start == "spawn" else points[0], points[:-1]])
    length = np.linalg.norm(points - starts, axis=1, keepdims=True)
    ends = points - CLEARANCE_MIN * (points - starts) / np.maximum(length, CLEARANCE_MIN)
    near = robot._replace(radii=robot.radii - CLEARANCE_MIN)  # touching is at a distance of 0
    if (find_crossed(body, near, starts, ends, _yaws(mission)[:-1]) >= 0).any():
        return []
    return [ConfigProblem(("touch", "body"), body[0].name, UNREACHED)]


def _yaws(mission: MissionConfig) -> Array:
    """Return the robot's yaw at the start, 0, and at each of n waypoints [rad], shape (n + 1,)."""
    yaws = [0.0]
    for waypoint in mission.waypoints:
        yaws.append(yaws[-1] if waypoint.yaw_deg is None else radians(waypoint.yaw_deg))
    return np.array(yaws)


def _check_ways(positions: Array, yaws: Array, place: _Place) -> Iterator[ConfigProblem]:
    """Report straight ways between successive `positions` [m], shape (n, 3), to an obstacle.

    The robot turns on its way: it must be clear with the yaw of either end [rad], shape (n,).
    """
    known, ends = place.known, (positions[:-1], positions[1:])
    through = find_crossed(known, place.robot, *ends, yaws[:-1])
    if (yaws[:-1] != yaws[1:]).any():
        through = np.maximum(through, find_crossed(known, place.robot, *ends, yaws[1:]))
    for index in np.flatnonzero(through >= 0)[:_REPORTED]:
        obstacle = known[through[index]]
        around = "around it or through the tube" if isinstance(obstacle, Tube) else "around it"
        before = f"waypoint {index - 1}" if index else "the spawn"
        reason = (
            f"the straight way there from {before} leads through {surface(obstacle)}, or within "
            f"{CLEARANCE_MIN:g} m of it; add waypoints in between that lead {around}"
        )
        yield _at_point(index, positions[index + 1], reason)


def _check_steps(steps: Steps, place: _Place) -> str:
    """Check the box that contains all random setpoints; return the problem, "" if none."""
    known, robot, fence, planar = place
    axis = np.linspace(-1, 1, 9)
    box = np.stack(np.meshgrid(axis, axis, axis, indexing="ij"), axis=-1).reshape(-1, 3)
    with np.errstate(over="ignore"):  # an infinite position is outside the fence, too
        positions = np.array(steps.centre_m) + box * np.array(steps.range_m)
    if outside_fence(fence, positions, planar=planar).any():
        where = _allowed(fence, planar=planar)
        return f"steps reach beyond the fence, or too near to it; {where}; choose a smaller range_m"
    hit = find_overlapped(known, robot, positions, np.zeros(len(positions))).max()
    if hit >= 0:
        where = surface(known[hit])
        return f"steps can end in {where}; choose another centre_m, range_m or scene"
    return ""


def _allowed(fence: Fence, *, planar: bool) -> str:
    """Describe where the guard lets the robot fly or drive, world frame."""
    verb = "drive" if planar else "fly"
    where = _spans(fence.inner_low, fence.inner_high, planar=planar)
    return f"the guard lets the robot {verb} at {where}"


def _spans(low: Vector, high: Vector, *, planar: bool) -> str:
    """Describe a box by its corners [m]; without heights for a `planar` robot."""
    sides = zip("xyz", low, high, strict=True)
    spans = [f"{axis} {below:g} to {above:g}" for axis, below, above in sides]
    return ", ".join(spans[: 2 if planar else 3]) + " [m]"


def _at_point(index: int, position: Array, reason: str) -> ConfigProblem:
    return ConfigProblem(("waypoints", str(index), "position_m"), _point(position), reason)


def _point(position: Array) -> str:
    return f"[{', '.join(f'{value:g}' for value in position)}]"
