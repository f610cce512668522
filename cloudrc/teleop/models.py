"""Define requests and answers of the API, and check the orders in requests.

The OpenAPI document comes from these models. Orders have the form of sections of a configuration
file: the same code checks them and describes their problems.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from math import cos, radians, sin
from typing import Annotated, Any, Literal, TypeVar

import numpy as np
from pydantic import AfterValidator, BaseModel, ConfigDict, Field, ValidationError
from pydantic_core import PydanticCustomError, from_json

from cloudrc.config.mission_check import check_mission
from cloudrc.config.problems import Problem as ConfigProblem
from cloudrc.config.problems import from_pydantic
from cloudrc.config.schema import MAX_WAYPOINTS, Finite, Mission, Section, TimeLimit, Waypoint
from cloudrc.errors import BadInputError
from cloudrc.geometry.clearance import ARM_HEIGHT, ARM_LENGTH
from cloudrc.geometry.placement import find_crossed_pipe
from cloudrc.geometry.scene import Scene
from cloudrc.messages import Start, Vector
from cloudrc.teleop.service import MissionService
from cloudrc.teleop.store import HELD, SHOWN, ConflictError, Order
from cloudrc.teleop.wire import Plan

Position = tuple[Finite, Finite, Finite]
BODY_MAX = 256 * 1024
"""Longest body of a request [bytes]."""
BODY_LIMIT = 5.0
"""Time limit for a body to arrive [s]."""
PROBLEMS_MAX = 50
"""Limit of the problems of one request that the answer describes."""


def _printable(text: str) -> str:
    """Refuse control characters, because they would control the terminals of readers."""
    if not text.isprintable():
        raise PydanticCustomError("unprintable", "must be one line of printable characters")
    return text


Text = Annotated[str, Field(max_length=200), AfterValidator(_printable)]

MISSION_EXAMPLE = {
    "name": "to the board",
    "start": "spawn",
    "time_limit_s": 60.0,
    "waypoints": [
        {"position_m": [0.5, 0.0, 0.7], "tolerance_m": 0.15, "dwell_s": 0.2},
        {"position_m": [0.5, 3.6, 0.7]},
    ],
}
GOTO_EXAMPLE = {"position_m": [0.5, 0.0, 1.2], "yaw_deg": 0.0}


class MissionRequest(Section):
    """Order to fly a mission."""

    name: Text = Field("", description="For people: one line of printable characters")
    description: str = Field("", description="One line, not kept")
    start: Literal["spawn", "here"] = Field("spawn", description="Where the mission starts")
    time_limit_s: TimeLimit | None = Field(
        None, description="For the whole mission, held time counted [s]; default: the experiment's"
    )
    waypoints: tuple[Waypoint, ...] = Field(
        (), max_length=MAX_WAYPOINTS, description="Points, in order"
    )
    contact: bool | None = Field(
        None,
        description="Whether the arm has to touch the board; "
        "default: if the experiment asks for it and the waypoints lead there",
    )
    key: Text = Field(
        "",
        description="A second mission under the same key is not made; "
        "one line of printable characters",
    )
    queue: bool = Field(False, description="Wait for the mission under way, if there is one")


class GoToRequest(Section):
    """Order to fly to a point."""

    position_m: Position = Field(description="Base position [m], world frame")
    yaw_deg: Finite = Field(0.0, description="Heading [deg]")


class _Answer(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True)


class Reached(_Answer):
    """Waypoint that was reached."""

    waypoint: int = Field(description="Its index, from 0")
    time_s: float = Field(description="When, since the mission began [s]")


class Failure(_Answer):
    """A rule that was broken."""

    code: str = Field(description="One word, for programs")
    text: str = Field(description="The same for people")


class Verdict(_Answer):
    """Result of a mission that has ended."""

    outcome: Literal["success", "failure", "invalid", "interrupted"] = Field(
        description="As in report.json"
    )
    exit_code: int = Field(description="Of a Job that flew it: 0, 1, 6 or 130")
    failures: list[Failure] = Field(description="Every rule that was broken")


class Event(_Answer):
    """An event of a mission."""

    id: int = Field(description="Rises with every event of all missions")
    mission: str = Field(description="Whose")
    event: str = Field(
        description="queued, starting, started, reached, held, resumed, goto, restarted, "
        "new_session, board_touched, pipe_touched, paused; at the end done, cancelled, timed_out, "
        "leg_timed_out, world_restarted, guard_stopped, emergency_stopped, taken_over or "
        "end_lost; acknowledged after emergency_stopped"
    )
    waypoint: int = Field(description="Index of the waypoint concerned")
    text: str = Field(description="The same in words")
    time_s: float = Field(description="Since the mission began [s]")


class MissionSummary(_Answer):
    """A mission, without its events."""

    id: str = Field(description="Given by teleop")
    name: str = Field(description="Given by its sender")
    key: str = Field(description="Likewise")
    state: Literal["queued", "starting", "flying", "held", "done", "failed", "cancelled"] = Field(
        description="Where it is"
    )
    waypoint: int = Field(description="Index of the waypoint that is flown to, from 0")
    waypoints: int = Field(description="How many it has")
    reached: list[Reached] = Field(description="Those that were reached")
    verdict: Verdict | None = Field(description="Once it has ended")


class MissionView(MissionSummary):
    """A mission with its events."""

    events: list[Event] = Field(max_length=SHOWN, description="The newest of them, oldest first")
    events_left_out: int = Field(description="How many there were before those")


class MissionList(_Answer):
    """All known missions."""

    missions: list[MissionSummary] = Field(description="Oldest first")


class Seen(_Answer):
    """The newest telemetry."""

    age_s: float = Field(description="Since it arrived [s]")
    epoch: int = Field(description="Session that it belongs to")
    world: str = Field(description="Names world's process")
    position_m: list[float | None] = Field(description="Of the base, measured [m], world frame")
    guard: Literal["GROUND", "TRACK", "HOLD", "LAND", "ESTOP"] = Field(
        description="State of the guard on board"
    )
    cause: str = Field(description="Why it is in it; of a robot that has landed, why it landed")
    guard_for_s: float | None = Field(
        description="For how long it has been seen in this state [s]; null once it has not been "
        "heard for 1 s: state, cause and all else are those of then"
    )
    next_step: str = Field(description="What comes next, or what the operator has to do for it")
    pipe_contacts: int = Field(description="How often a pipe has been touched so far")
    touch_speed_mps: float | None = Field(description="Of the tip at the board [m/s]")
    horizon_s: float | None = Field(description="How far cloud looks ahead [s]")
    rtt_s: float | None = Field(description="Last round trip, hold excluded [s]")
    loop_delay_s: float | None = Field(description="The same, hold included [s]")


class StateView(_Answer):
    """The present state of missions and robot."""

    mission: MissionSummary | None = Field(description="The one under way")
    queue: list[str] = Field(description="Ids of those that wait")
    cloud_age_s: float | None = Field(
        description="Since cloud was heard [s], which says at least every 0.2 s that it lives; "
        "null if it never was"
    )
    seen: Seen | None = Field(description="Null until the robot has been seen")


class Stopped(_Answer):
    """Answer to an emergency stop, which is under way to the robot."""

    id: str | None = Field(description="The mission that was under way and has failed")
    state: Literal["stopping"] = Field(description="Until the guard on board is in ESTOP")


class Acknowledged(_Answer):
    """Answer to an acknowledgement, which is under way to the robot."""

    state: Literal["acknowledged"] = Field(
        description="The next mission may fly; a landing low over the ground ends first, and "
        "after a stop or a touch-down the robot takes off only once it has been still, 0.5 m "
        "inside the fence"
    )


class Problem(_Answer):
    """One value that cannot be used."""

    path: str = Field(description="Keys down to the value, joined by dots")
    index: int | None = Field(description="Of the waypoint concerned; null if it is none")
    value: str = Field(description="In words; empty if it is not there")
    reason: str = Field(description="What it must be, and what to do")


class Refusal(_Answer):
    """Reason why a request is refused."""

    detail: str = Field(description="In words")
    id: str | None = Field(None, description="The mission that is in the way")
    problems: list[Problem] | None = Field(None, description="Every value that cannot be used")


REFUSALS: dict[int | str, dict[str, Any]] = {
    code: {"model": Refusal, "description": text}
    for code, text in {
        401: "There is no valid token in the request",
        403: "The token is a reader's",
        404: "There is no such mission",
        408: f"The body did not arrive within {BODY_LIMIT:g} s",
        409: "The state does not allow it; `id` names the mission in the way",
        413: f"The body is longer than {BODY_MAX // 1024} KiB",
        422: "A value cannot be used; `problems` has every one",
        429: "Too many requests at the same time; try again in a second",
        503: "Not now: teleop starts or ends, another has the journal, it cannot be written, or "
        "too much waits: try again. Or teleop did not answer within 2 s, and may do it yet: look. "
        "An emergency stop is told all the same, unless another teleop flies the robot",
    }.items()
}
ABOUT = """\
Fly missions, or steer by hand. One mission is flown at a time; a second one is refused with the
id of the first, or waits if it says `queue`. A mission posted again under the same `key` is not
made again. Positions are in metres, x forward, y left, z up.

Every request needs a token: `Authorization: Bearer TOKEN`. A reader's may look, an operator's may
command. `POST /v1/estop` stops the rotors at once. It and `POST /v1/hold` are served even while
other requests are refused as too many.
"""


def inlined(model: type[BaseModel]) -> dict[str, Any]:
    """Return a model's JSON schema without references, as needed for a request body."""
    schema = model.model_json_schema()
    parts = schema.pop("$defs", {})

    def resolve(node: Any) -> Any:
        if isinstance(node, list):
            return [resolve(item) for item in node]
        if not isinstance(node, dict):
            return node
        if "$ref" in node:
            return resolve(parts[node["$ref"].rpartition("/")[2]])
        return {key: resolve(value) for key, value in node.items()}

    return dict(resolve(schema))


@dataclass(frozen=True, slots=True)
class Surroundings:
    """Facts about the experiment that the check of an order needs.

    Attributes:
        scene: The scene for the check of waypoints.
        time_limit: Time limit of missions without their own limit [s].
        contact: Whether a mission that leads to the board has to touch the board, if the mission
            itself does not specify this.
        plan: Makes a plan from a checked mission and its time limit [s].
    """

    scene: Scene
    time_limit: float
    contact: bool
    plan: Callable[[Mission, float], Plan]


_Request = TypeVar("_Request", bound=Section)


class RefusedError(BadInputError):
    """Report a request that cannot be used; `problems` say why."""

    def __init__(self, problems: list[ConfigProblem]) -> None:
        super().__init__("; ".join(map(str, problems[:3])))
        self.problems = problems


def read_mission(body: bytes, scene: Scene) -> tuple[MissionRequest, Mission]:
    """Read a mission and check it against the scene.

    Raises:
        RefusedError: If the mission has problems; contains all of them.
    """
    _refuse_too_many(body)
    request = _parse(body, MissionRequest)
    if not request.waypoints:  # an experiment's mission may have steps in their place
        _refuse([ConfigProblem(("waypoints",), "", "none given; give at least one")])
    mission = Mission(start=request.start, waypoints=request.waypoints)
    _refuse(check_mission(mission, scene))
    return request, mission


def read_order(body: bytes, surroundings: Surroundings) -> Order:
    """Read a mission, check it, and plan it.

    Raises:
        RefusedError: If the mission has problems; contains all of them.
    """
    request, mission = read_mission(body, surroundings.scene)
    limit = surroundings.time_limit if request.time_limit_s is None else request.time_limit_s
    contact = request.contact
    if contact is None:
        contact = surroundings.contact and leads_to_board(mission, surroundings.scene)
    plan = surroundings.plan(mission, limit)
    return Order(plan, request.name, request.key, contact, request.queue)


def read_goto(body: bytes, scene: Scene) -> GoToRequest:
    """Read a point and check it against the scene.

    Raises:
        RefusedError: If the point has problems; contains all of them.
    """
    request = _parse(body, GoToRequest)
    waypoint = Waypoint(position_m=request.position_m, yaw_deg=request.yaw_deg)
    problems = check_mission(Mission(start="here", waypoints=(waypoint,)), scene)
    _refuse(
        [ConfigProblem(problem.path[2:], problem.value, problem.reason) for problem in problems]
    )
    return request


def check_way(service: MissionService, target: Vector | None, scene: Scene) -> None:
    """Refuse a flight if the straight way from the robot's position crosses the wall of a pipe.

    Args:
        service: The service; call this function in its thread.
        target: End of the way [m], world frame, shape (3,); None: the next waypoint of the held
            mission.
        scene: Scene with the pipes.

    Raises:
        ConflictError: If a wall is in the way; the text names the pipe.
    """
    seen, waiting = service.sight.seen, service.book.open()
    mission = waiting[0] if waiting else None
    if target is None and mission is not None:
        legs, count = mission.order.plan.legs, len(mission.reached)
        target = legs[count].position if count < len(legs) else None
    if seen is None or target is None or (mission is not None and mission.state != HELD):
        return  # the service refuses it for another reason, or there is nothing to check
    through = int(find_crossed_pipe(scene, np.array([seen.position]), np.array([target]))[0])
    if through >= 0:
        here, there = (f"[{', '.join(f'{v:.2f}' for v in p)}]" for p in (seen.position, target))
        reason = (
            f"the straight way from where the robot is, {here}, to {there} leads through the wall "
            f"of {scene.pipes[through].name}; go round it first, by 'cloudrc mission goto'"
        )
        raise ConflictError(reason, mission.id if mission else "")


def check_first_way(service: MissionService, order: Order, scene: Scene) -> None:
    """Check the way to the first waypoint of a mission that begins at once, where the robot is."""
    begins = not service.book.open() and service.book.with_key(order.key) is None
    if begins and order.plan.start is Start.HERE:
        check_way(service, order.plan.legs[0].position, scene)


def leads_to_board(mission: Mission, scene: Scene) -> bool:
    """Return whether the arm's tip is at the board, or behind its face, at any waypoint."""
    board = scene.board
    if board is None:
        return False
    for waypoint in mission.waypoints:
        (x, y, z), yaw = waypoint.position_m, radians(waypoint.yaw_deg)
        x, y, z = x + ARM_LENGTH * cos(yaw), y + ARM_LENGTH * sin(yaw), z + ARM_HEIGHT
        if x >= board.x and board.y[0] <= y <= board.y[1] and board.z[0] <= z <= board.z[1]:
            return True
    return False


def as_json(problem: ConfigProblem) -> dict[str, str | int | None]:
    """Return a problem as the API shows it."""
    index = next((int(key) for key in problem.path if key.isdecimal()), None)
    return {
        "path": ".".join(problem.path),
        "index": index if problem.path[:1] == ("waypoints",) else None,
        "value": problem.value,
        "reason": problem.reason,
    }


def _refuse_too_many(body: bytes) -> None:
    """Refuse too many waypoints before their check: to describe all problems would take long."""
    try:
        points = from_json(body)["waypoints"]
    except (ValueError, TypeError, KeyError):
        return  # the model words the problem
    if isinstance(points, list) and len(points) > MAX_WAYPOINTS:
        reason = f"at most {MAX_WAYPOINTS}; split the mission"
        _refuse([ConfigProblem(("waypoints",), str(len(points)), reason)])


def _parse(body: bytes, model: type[_Request]) -> _Request:
    try:
        return model.model_validate_json(body)
    except ValidationError as error:
        first = error.errors(include_url=False, include_input=False)[0]
        if first["type"] == "json_invalid":
            problems = [ConfigProblem((), "", f"not JSON: {first['ctx']['error']}")]
        elif not first["loc"]:
            problems = [ConfigProblem((), "", "must be a mapping of keys")]
        else:
            problems = from_pydantic(error, model, limit=PROBLEMS_MAX)
        raise RefusedError(problems) from None


def _refuse(problems: list[ConfigProblem]) -> None:
    if problems:
        raise RefusedError(problems)
