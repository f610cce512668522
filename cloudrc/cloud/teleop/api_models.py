"""What the API takes and gives, with units, ranges and examples: the OpenAPI schema is made of it.

Requests are sections like those of a configuration file, and are checked by the same code.
"""

from __future__ import annotations

from typing import Annotated, Any, Literal

from pydantic import AfterValidator, BaseModel, ConfigDict, Field
from pydantic_core import PydanticCustomError

from cloudrc.cloud.teleop.service_mission import SHOWN
from cloudrc.config.schema import MAX_WAYPOINTS, Finite, Limit, Section, Waypoint

Position = tuple[Finite, Finite, Finite]


def _printable(text: str) -> str:
    """Refuse what would steer the terminals, or break the lines, of all who are shown it."""
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


class MissionRequest(Section):
    """A mission to fly."""

    name: Text = Field("", description="For people: one line of printable characters")
    description: str = Field("", description="One line, not kept")
    start: Literal["spawn", "here"] = Field("spawn", description="Where the mission starts")
    time_limit_s: Limit | None = Field(
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
    """A point to fly to."""

    position_m: Position = Field(description="Base position [m], world frame")
    yaw_deg: Finite = Field(0.0, description="Heading [deg]")


class _Answer(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True)


class Reached(_Answer):
    """A waypoint that was reached."""

    waypoint: int = Field(description="Its index, from 0")
    time_s: float = Field(description="When, since the mission began [s]")


class Failure(_Answer):
    """A rule that was broken."""

    code: str = Field(description="One word, for programs")
    text: str = Field(description="The same for people")


class Verdict(_Answer):
    """What became of a mission that has ended."""

    outcome: Literal["success", "failure", "invalid", "interrupted"] = Field(
        description="As in report.json"
    )
    exit_code: int = Field(description="Of a Job that flew it: 0, 1, 6 or 130")
    failures: list[Failure] = Field(description="Every rule that was broken")


class Event(_Answer):
    """Something that happened to a mission."""

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
    """A mission with everything that has happened to it."""

    events: list[Event] = Field(max_length=SHOWN, description="The newest of them, oldest first")
    events_left_out: int = Field(description="How many there were before those")


class MissionList(_Answer):
    """All missions that are known."""

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
    """How things are now."""

    mission: MissionSummary | None = Field(description="The one under way")
    queue: list[str] = Field(description="Ids of those that wait")
    cloud_age_s: float | None = Field(
        description="Since cloud was heard [s], which says at least every 0.2 s that it lives; "
        "null if it never was"
    )
    seen: Seen | None = Field(description="Null until the robot has been seen")


class Stopped(_Answer):
    """An emergency stop on its way."""

    id: str | None = Field(description="The mission that was under way and has failed")
    state: Literal["stopping"] = Field(description="Until the guard on board is in ESTOP")


class Acknowledged(_Answer):
    """An acknowledgement on its way."""

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
    """Why something is not done."""

    detail: str = Field(description="In words")
    id: str | None = Field(None, description="The mission that is in the way")
    problems: list[Problem] | None = Field(None, description="Every value that cannot be used")


def inlined(model: type[BaseModel]) -> dict[str, Any]:
    """Give a model's JSON schema without references, as the body of a request wants it."""
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
