"""Checks what is posted to the API: bytes come in; a mission that can be flown, or problems go out.

The same code that checks an experiment's file, so that the words are the same.
"""

from __future__ import annotations

from math import cos, radians, sin
from typing import TypeVar

import numpy as np
from pydantic import ValidationError
from pydantic_core import from_json

from cloudrc.cloud.teleop.api_models import GoToRequest, MissionRequest
from cloudrc.cloud.teleop.service import MissionService
from cloudrc.cloud.teleop.service_book import ConflictError
from cloudrc.cloud.teleop.service_mission import HELD, Order
from cloudrc.config.mission_check import check_mission
from cloudrc.config.problems import Problem, from_pydantic
from cloudrc.config.schema import MAX_WAYPOINTS, Mission, Section, Waypoint
from cloudrc.errors import BadInputError
from cloudrc.geometry.placement import crossed_pipe
from cloudrc.geometry.robot import ARM_HEIGHT, ARM_LENGTH
from cloudrc.geometry.scene import Scene
from cloudrc.messages import Start, Vector

PROBLEMS_MAX = 50
"""Of one request, that are put into words."""

_Request = TypeVar("_Request", bound=Section)


class RefusedError(BadInputError):
    """A request that cannot be used; `problems` say why."""

    def __init__(self, problems: list[Problem]) -> None:
        super().__init__("; ".join(map(str, problems[:3])))
        self.problems = problems


def read_mission(body: bytes, scene: Scene) -> tuple[MissionRequest, Mission]:
    """Read a mission and check it against the scene.

    Raises:
        RefusedError: With everything that is wrong.
    """
    _refuse_too_many(body)
    request = _parse(body, MissionRequest)
    if not request.waypoints:  # an experiment's mission may have steps in their place
        _refuse([Problem(("waypoints",), "", "none given; give at least one")])
    mission = Mission(start=request.start, waypoints=request.waypoints)
    _refuse(check_mission(mission, scene))
    return request, mission


def read_goto(body: bytes, scene: Scene) -> GoToRequest:
    """Read a point and check it against the scene.

    Raises:
        RefusedError: With everything that is wrong.
    """
    request = _parse(body, GoToRequest)
    waypoint = Waypoint(position_m=request.position_m, yaw_deg=request.yaw_deg)
    problems = check_mission(Mission(start="here", waypoints=(waypoint,)), scene)
    _refuse([Problem(problem.path[2:], problem.value, problem.reason) for problem in problems])
    return request


def check_way(service: MissionService, target: Vector | None, scene: Scene) -> None:
    """Refuse to fly straight from where the robot is seen through the wall of a pipe.

    Args:
        service: In its own thread.
        target: Where to [m], world frame, shape (3,); None: to the next waypoint of what is held.
        scene: With the pipes.

    Raises:
        ConflictError: If a wall is in the way; says which.
    """
    seen, waiting = service.sight.seen, service.book.open()
    mission = waiting[0] if waiting else None
    if target is None and mission is not None:
        legs, count = mission.order.plan.legs, len(mission.reached)
        target = legs[count].position if count < len(legs) else None
    if seen is None or target is None or (mission is not None and mission.state != HELD):
        return  # what else is in the way is for others to say
    through = int(crossed_pipe(scene, np.array([seen.position]), np.array([target]))[0])
    if through >= 0:
        here, there = (f"[{', '.join(f'{v:.2f}' for v in p)}]" for p in (seen.position, target))
        reason = (
            f"the straight way from where the robot is, {here}, to {there} leads through the wall "
            f"of {scene.pipes[through].name}; go round it first, by 'cloudrc mission goto'"
        )
        raise ConflictError(reason, mission.id if mission else "")


def check_first_way(service: MissionService, order: Order, scene: Scene) -> None:
    """Likewise of the way to the first waypoint, where a new mission begins from here and now."""
    begins = not service.book.open() and service.book.with_key(order.key) is None
    if begins and order.plan.start is Start.HERE:
        check_way(service, order.plan.legs[0].position, scene)


def leads_to_board(mission: Mission, scene: Scene) -> bool:
    """Say whether the arm's tip is at the board or behind its face at some waypoint."""
    board = scene.board
    if board is None:
        return False
    for waypoint in mission.waypoints:
        (x, y, z), yaw = waypoint.position_m, radians(waypoint.yaw_deg)
        x, y, z = x + ARM_LENGTH * cos(yaw), y + ARM_LENGTH * sin(yaw), z + ARM_HEIGHT
        if x >= board.x and board.y[0] <= y <= board.y[1] and board.z[0] <= z <= board.z[1]:
            return True
    return False


def as_json(problem: Problem) -> dict[str, str | int | None]:
    """Show a problem as the API does."""
    index = next((int(key) for key in problem.path if key.isdecimal()), None)
    return {
        "path": ".".join(problem.path),
        "index": index if problem.path[:1] == ("waypoints",) else None,
        "value": problem.value,
        "reason": problem.reason,
    }


def _refuse_too_many(body: bytes) -> None:
    """Count before anything is checked: what is wrong with each of too many would take long."""
    try:
        points = from_json(body)["waypoints"]
    except (ValueError, TypeError, KeyError):
        return  # whatever it is, the model says it in words
    if isinstance(points, list) and len(points) > MAX_WAYPOINTS:
        reason = f"at most {MAX_WAYPOINTS}; split the mission"
        _refuse([Problem(("waypoints",), str(len(points)), reason)])


def _parse(body: bytes, model: type[_Request]) -> _Request:
    try:
        return model.model_validate_json(body)
    except ValidationError as error:
        first = error.errors(include_url=False, include_input=False)[0]
        if first["type"] == "json_invalid":
            problems = [Problem((), "", f"not JSON: {first['ctx']['error']}")]
        elif not first["loc"]:
            problems = [Problem((), "", "must be a mapping of keys")]
        else:  # words take time: a hostile mission must not cost more of it than an honest one
            problems = from_pydantic(error, model, limit=PROBLEMS_MAX)
        raise RefusedError(problems) from None


def _refuse(problems: list[Problem]) -> None:
    if problems:
        raise RefusedError(problems)
