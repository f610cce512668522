# SPDX-License-Identifier: Apache-2.0

"""Define the requests and answers of the API, and check the missions and points in requests.

The OpenAPI document is made from these models. A request has the form of a section of a
configuration file, so that the same code checks both and describes the problems.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from math import radians
from typing import Annotated, Any, Literal, TypeVar, get_args

from pydantic import ConfigDict, Field, ValidationError

from cloudrc.base.errors import BadInputError
from cloudrc.config.follow import Follow
from cloudrc.config.ground import put_on_ground
from cloudrc.config.heading import WHY, without_held_yaws
from cloudrc.config.mission_check import check_mission
from cloudrc.config.problems import ConfigProblem, from_pydantic
from cloudrc.config.schema import (
    MAX_WAYPOINTS,
    Carrot,
    Finite,
    JudgedBy,
    MissionConfig,
    Place,
    TimeLimit,
    Touch,
    Waypoint,
    Yaw,
)
from cloudrc.config.section import Described, Section
from cloudrc.config.world import WorldFiles
from cloudrc.results.metrics.verdict import FailureCode, Outcome
from cloudrc.teleop.store import SHOWN, Order
from cloudrc.teleop.wire import EventName, Leg, Plan
from cloudrc.wire.messages import Vector
from cloudrc.wire.records import MissionEnd, MissionState

PROBLEMS_MAX = 50
"""Largest number of problems that one answer lists."""
LEASE_MIN, LEASE_MAX = 5, 3600
"""Limits of a mission's lease [s]. A shorter lease would end a mission whose watcher waits for
a busy processor; with a longer one, a robot would fly for hours without a watcher."""

ORDERED = ("start", "waypoints", "follow", "carrot", "judged_by", "touch")
"""Keys of an experiment's mission that an order has, too."""

Text = Annotated[str, Field(max_length=200)]


class MissionRequest(Section):
    """Order to fly a mission."""

    name: Text = ""
    """Shown to people"""
    description: str = ""
    """One line, not kept"""
    start: Literal["spawn", "here"] = "spawn"
    """Where the mission starts"""
    time_limit_s: TimeLimit | None = None
    """With all holds [s]; default: 3 times the expected time, at least 60 s"""
    waypoints: tuple[Waypoint, ...] = Field((), max_length=MAX_WAYPOINTS)
    """In order"""
    follow: Follow | None = None
    """What to keep in the camera's picture, in place of waypoints"""
    carrot: Carrot | None = None
    """How the setpoint moves; null: it jumps"""
    judged_by: JudgedBy = "measured"
    """Position by which waypoints count as reached"""
    touch: Touch | None = None
    """What the robot has to touch; null: nothing"""
    key: Text = ""
    """Teleop makes one mission for each key"""
    queue: bool = False
    """Wait for the mission under way, if there is one"""
    lease_s: Annotated[float, Field(ge=LEASE_MIN, le=LEASE_MAX)] | None = None
    """Cancel the mission if nobody renews it for this time [s]; null: it needs no watcher"""


class GoToRequest(Section):
    """Order to fly to a point."""

    position_m: Place
    """Base position [m], world frame"""
    yaw_deg: Yaw | None = None
    """Heading there [deg], for a robot that can turn; null: any"""


class DriveRequest(Section):
    """Order to move the setpoint by hand."""

    velocity_mps: tuple[Finite, Finite, Finite]
    """Velocity of the setpoint [m/s], world frame; above 1.5 m/s it is scaled down"""
    yaw_rate_radps: Finite | None = None
    """Yaw rate [rad/s], at most 1, for a robot that turns; with it, also with 0, the velocity is in
    the frame of the robot's heading: x ahead, y to the left. null: no turn"""


EXAMPLES: dict[type[Section], dict[str, Any]] = {
    MissionRequest: {
        "name": "to the wall",
        "start": "spawn",
        "time_limit_s": 60.0,
        "waypoints": [
            {"position_m": [0.5, 0.0, 0.7], "tolerance_m": 0.15, "dwell_s": 0.2},
            {"position_m": [0.5, 3.6, 0.7]},
        ],
    },
    GoToRequest: {"position_m": [0.5, 0.0, 1.2]},
    DriveRequest: {"velocity_mps": [0.5, 0.0, 0.0]},
}


class _Answer(Described):
    model_config = ConfigDict(extra="forbid", frozen=True)


class Reached(_Answer):
    """A waypoint that the robot has reached, and when."""

    waypoint: int
    """Index of the waypoint, from 0"""
    time_s: float
    """Time since the mission began [s]"""


class Failure(_Answer):
    """A rule that the mission has broken."""

    code: FailureCode
    """One word, for programs"""
    text: str
    """Reason in words"""


class Verdict(_Answer):
    """Result of a mission that has ended."""

    outcome: Outcome
    """As in report.json"""
    exit_code: int
    """Exit code of a Job that flies the mission: 0, 1, 6 or 130"""
    failures: list[Failure]
    """Every rule that the mission has broken"""


class Event(_Answer):
    """An event of a mission."""

    id: int
    """Number of the event; all missions share one count"""
    mission: str
    """Id of the mission"""
    event: EventName = Field(description=f"At the end {', '.join(get_args(MissionEnd))}")
    waypoint: int
    """Index of the waypoint, from 0"""
    text: str
    """Event in words"""
    time_s: float
    """Time since the mission began [s]"""


class MissionSummary(_Answer):
    """A mission, without its events."""

    id: str
    """Id, given by teleop"""
    name: str
    """Name in the order"""
    key: str
    """Key in the order"""
    state: MissionState
    by_hand: bool
    """Whether an operator drives the robot by hand"""
    waypoint: int
    """Index of the waypoint to which the robot flies, from 0"""
    waypoints: int
    """Number of waypoints; 0: the mission follows a file of setpoints"""
    reached: list[Reached]
    """The reached waypoints"""
    verdict: Verdict | None
    """Null until the mission has ended"""


class MissionView(MissionSummary):
    """A mission with its events."""

    route_m: list[tuple[float, float, float]]
    """The waypoints [m], world frame"""
    events: list[Event] = Field(max_length=SHOWN)
    """The newest events, oldest first"""
    events_left_out: int
    """Number of older events"""


class MissionList(_Answer):
    """All known missions."""

    missions: list[MissionSummary]
    """Oldest first"""


class SensorView(_Answer):
    """One of the robot's own sensors."""

    name: str
    """Name in robot.yaml"""
    value: float | None
    """What it shows, in its unit; null if that is no number"""
    unit: str
    """Unit in robot.yaml"""


class Seen(_Answer):
    """The newest telemetry."""

    age_s: float
    """Time since the telemetry arrived [s]"""
    epoch: int
    """Number of the session between cloud and world"""
    world: str
    """Identifies world's process"""
    position_m: list[float | None]
    """Measured position of the base [m], world frame"""
    guard: Literal["GROUND", "TRACK", "HOLD", "LAND", "ESTOP"]
    """State of the guard"""
    cause: str
    """Why the guard is in this state; after a landing, why the robot landed"""
    guard_for_s: float | None
    """Time in this guard state [s]; null if `age_s` is above 1 s"""
    next_step: str
    """What the robot does next, or what the operator has to do"""
    obstacle_contacts: int
    """Number of contacts with obstacles in the mission"""
    touch_speed_mps: float | None
    """Speed of the first touch of what the mission has to touch [m/s]"""
    sensors: list[SensorView]
    """The robot's own sensors, in the order of robot.yaml"""
    horizon_s: float | None
    """Prediction horizon of cloud's last command [s]"""
    rtt_s: float | None
    """Last round trip, without the waiting time at the robot [s]"""
    loop_delay_s: float | None
    """Last round trip, with the waiting time at the robot [s]"""


class StateView(_Answer):
    """The present state of missions and robot."""

    mission: MissionSummary | None
    """The mission under way"""
    queue: list[str]
    """Ids of the missions that wait"""
    cloud_age_s: float | None
    """Age of the last message of cloud [s]; null before one"""
    seen: Seen | None
    """Null before the first telemetry"""


class Stopped(_Answer):
    """Answer to a command for an emergency stop; the robot may not have received the stop yet."""

    id: str | None
    """The mission that was under way and has failed"""
    state: Literal["stopping"]
    """Lasts until the robot's guard is in ESTOP"""


class Acknowledged(_Answer):
    """Answer to an acknowledgement, which the robot may not have received yet."""

    state: Literal["acknowledged"]
    """A mission can fly once the robot stands still"""


class Problem(_Answer):
    """One invalid value in a request."""

    path: str
    """Keys down to the value, joined by dots"""
    index: int | None
    """Index of the waypoint with the problem; null without a waypoint"""
    value: str
    """Value in words; empty if missing"""
    reason: str
    """Rule for the value, and remedy"""


class Refusal(_Answer):
    """Reason why a request is refused."""

    detail: str
    """Reason in words"""
    id: str | None = None
    """The mission that is in the way"""
    problems: list[Problem] | None = None
    """Every value that cannot be used"""


class RefusedError(BadInputError):
    """Report that a request is not valid; `problems` lists all reasons."""

    status = 422  # of the answer

    def __init__(self, problems: list[ConfigProblem]) -> None:
        super().__init__("; ".join(map(str, problems[:3])))
        self.problems = problems


_Request = TypeVar("_Request", bound=Section)


@dataclass(frozen=True)
class RequestReader:
    """Reads and checks the bodies of requests; raises a RefusedError that lists all problems.

    Attributes:
        files: Robot and scene.
        plan: Makes a plan from a mission and a time limit [s], which may be None.
        touch: What the experiment's mission has to touch: a point there is no problem.
    """

    files: WorldFiles
    plan: Callable[[MissionConfig, float | None], Plan]
    touch: Touch | None = None

    def order(self, body: bytes) -> Order:
        """Read and plan a mission."""
        request = _parse(body, MissionRequest)
        if not (request.waypoints or request.follow):  # only an experiment may have steps instead
            raise RefusedError([ConfigProblem(("waypoints",), "", "none given; give at least one")])
        mission = MissionConfig(**{name: getattr(request, name) for name in ORDERED})
        mission = put_on_ground(mission, self.files)
        if problems := check_mission(mission, self.files):
            raise RefusedError(problems)
        mission = without_held_yaws(mission, self.files.robot.heading)
        planned = self.plan(mission, request.time_limit_s)
        lease = request.lease_s or 0.0
        return Order(planned, request.name, request.key, request.touch, request.queue, lease)

    def goto(self, body: bytes) -> Leg:
        """Read a point."""
        request = _parse(body, GoToRequest)
        # A robot that turns towards its velocity turns on the spot once it is there.
        on_the_spot = request.yaw_deg if self.files.robot.heading == "velocity" else None
        yaw_deg = request.yaw_deg if on_the_spot is None else None
        waypoint = Waypoint(position_m=request.position_m, yaw_deg=yaw_deg)
        # What is an obstacle depends on the mission under way; the service checks the way there.
        mission = MissionConfig(start="here", waypoints=(waypoint,), touch=self.touch)
        mission = put_on_ground(mission, self.files)
        if problems := check_mission(mission, self.files):
            raise RefusedError([ConfigProblem(p.path[2:], p.value, p.reason) for p in problems])
        (waypoint,) = without_held_yaws(mission, self.files.robot.heading).waypoints
        yaw_deg = waypoint.yaw_deg if on_the_spot is None else on_the_spot
        return Leg(waypoint.position_m, None if yaw_deg is None else radians(yaw_deg))

    def drive(self, body: bytes) -> tuple[Vector, float | None]:
        """Read a velocity [m/s] and a yaw rate [rad/s]."""
        request = _parse(body, DriveRequest)
        velocity, yaw_rate = request.velocity_mps, request.yaw_rate_radps
        if yaw_rate and self.files.robot.heading == "fixed":
            reason = f"{WHY['fixed']}; leave it out, or choose another robot, such as x2"
            raise RefusedError([ConfigProblem(("yaw_rate_radps",), f"{yaw_rate:g}", reason)])
        if self.files.robot.planar and velocity[2] != 0.0:
            reason = "leads up or down, but this robot stays on the ground; set it to 0"
            raise RefusedError([ConfigProblem(("velocity_mps", "2"), f"{velocity[2]:g}", reason)])
        return velocity, yaw_rate


def as_json(problem: ConfigProblem) -> dict[str, str | int | None]:
    """Return a problem in the form of the API's model `Problem`."""
    path = problem.path
    index = int(path[1]) if path[:1] == ("waypoints",) and len(path) > 1 else None
    shown = {"path": ".".join(path), "index": index}
    return {**shown, "value": problem.value, "reason": problem.reason}


def _parse(body: bytes, model: type[_Request]) -> _Request:
    try:
        return model.model_validate_json(body)
    except ValidationError as error:
        problems = from_pydantic(error, model, limit=PROBLEMS_MAX)
    if not problems[0].path:
        problems = [ConfigProblem((), "", "must be JSON: a mapping of keys")]
    raise RefusedError(problems)
