"""The messages of teleop: what it is told by cloud and operator, and what it says about a mission.

What it tells the others is defined elsewhere: `Setpoint` to the controller and `OperatorRequest`
to the robot in `cloudrc.messages`, `MissionEvent` to the recorder in `cloudrc.records`.

The plan of a mission: a person's or an experiment's waypoints come in, checked legs go out.

Teleop's datagrams: messages between cloud's and teleop's process become JSON and come back.

One message each: the name of its type, then its fields in order. Both processes are of one image
and one pod; what arrives is checked all the same, since a file that both can write to is no proof
of who wrote.
"""

from __future__ import annotations

import json
from dataclasses import dataclass
from enum import IntEnum
from math import isfinite, isnan, nan
from typing import Any, NamedTuple, TypeAlias

from pydantic import TypeAdapter, ValidationError

from cloudrc.errors import BadInputError
from cloudrc.messages import (
    MISSION_OVER,
    ZERO,
    Cause,
    GuardState,
    OperatorRequest,
    Request,
    Setpoint,
    Start,
    Vector,
)
from cloudrc.records import MissionEvent


@dataclass(frozen=True, slots=True)
class Leg:
    """The way to one waypoint, which is reached by staying near it.

    Attributes:
        position: Waypoint [m], world frame, shape (3,).
        yaw: Heading to hold [rad].
        tolerance: Distance that counts as there [m]. Infinite: anywhere counts, and the leg lasts
            `dwell`; that is how steps at fixed instants are flown.
        dwell: How long to be seen within the tolerance without a break [s].
        time_limit: Longest duration of the leg, held time not counted [s].
    """

    position: Vector
    yaw: float = 0.0
    tolerance: float = 0.10
    dwell: float = 0.5
    time_limit: float = 60.0

    def __post_init__(self) -> None:
        """Check the values.

        Raises:
            BadInputError: If one is not a number or out of range.
        """
        if not all(map(isfinite, (*self.position, self.yaw))):
            raise BadInputError(f"waypoint {self.position}, yaw {self.yaw}: has to be finite")
        if isnan(self.tolerance) or self.tolerance <= 0:
            raise BadInputError(f"waypoint tolerance {self.tolerance} m: has to be above 0")
        if not (isfinite(self.dwell) and self.dwell >= 0):
            raise BadInputError(f"waypoint dwell {self.dwell} s: has to be finite and >= 0")
        if not (isfinite(self.time_limit) and self.time_limit > 0):
            raise BadInputError(f"time limit {self.time_limit} s: has to be finite and above 0")


@dataclass(frozen=True, slots=True)
class Plan:
    """A mission.

    Attributes:
        legs: What to fly, in order; at least one.
        start: From the spawn, in a fresh world, or from here.
        time_limit: Longest duration of the mission, held time counted [s].
    """

    legs: tuple[Leg, ...]
    start: Start = Start.SPAWN
    time_limit: float = 60.0

    def __post_init__(self) -> None:
        """Check the values.

        Raises:
            BadInputError: If there is no leg or the limit is out of range.
        """
        if not self.legs:
            raise BadInputError("a mission needs at least one waypoint")
        if not (isfinite(self.time_limit) and self.time_limit > 0):
            raise BadInputError(f"time limit {self.time_limit} s: has to be finite and above 0")


NO_PLAN = Plan((Leg(ZERO),))
"""Stands in until the first mission starts; never flown."""


class Seen(NamedTuple):
    """What the newest telemetry says, as it arrives: cloud to teleop.

    Attributes:
        epoch: Session that it belongs to.
        position: Measured, of the base [m], world frame, shape (3,).
        guard: State of the guard.
        mission: Number of the last operator request that world has acted on; 0 if none.
        world: Names world's process: a restarted world has another name, a restarted cloud opens
            a new epoch in the same world.
        pipe_contacts: How often the robot has begun to touch a pipe so far.
        touch_speed: Speed of the arm's tip when it met the board [m/s]; NaN before that.
        slip_ns: By how much world's clock lags its machine's [ns].
        horizon: How far cloud looks ahead [s]; NaN before its first command.
        rtt: Last round trip, hold excluded [s]; NaN likewise.
        loop_delay: Last `now - echo_stamp`, hold included [s]; NaN likewise.
        mission_id: The mission that world was told to start last; 0 if none.
        reached: How many of its waypoints world has been told are reached, or `MISSION_OVER`.
        cause: Why the guard is in its state.
    """

    epoch: int
    position: Vector
    guard: GuardState
    mission: int
    world: str = ""
    pipe_contacts: int = 0
    touch_speed: float = nan
    slip_ns: int = 0
    horizon: float = nan
    rtt: float = nan
    loop_delay: float = nan
    mission_id: int = 0
    reached: int = 0
    cause: Cause = Cause.SPAWN


@dataclass(frozen=True, slots=True)
class StartMission:
    """Operator: fly this plan.

    Attributes:
        plan: Checked.
        mission_id: Names it on board, where its progress is kept, too; 0 for not at all.
        again: Whether a teleop before this one may have flown it: it is not, once it is over.
    """

    plan: Plan
    mission_id: int = 0
    again: bool = False


@dataclass(frozen=True, slots=True)
class Continue:
    """Teleop itself, after a restart: go on with a mission that was under way.

    Attributes:
        plan: As it was started.
        leg: Index of the waypoint that was flown to.
        elapsed: How long the mission had lasted [s].
        world: The world that it was flown in; in another one it has failed.
        held: Whether the operator had stopped it.
        mission_id: As it was started.
    """

    plan: Plan
    leg: int
    elapsed: float
    world: str
    held: bool = False
    mission_id: int = 0


@dataclass(frozen=True, slots=True)
class Hold:
    """Operator: stop where you are and wait."""


@dataclass(frozen=True, slots=True)
class Resume:
    """Operator: go on with the leg that was held."""


@dataclass(frozen=True, slots=True)
class Cancel:
    """Operator: end the mission."""


@dataclass(frozen=True, slots=True)
class GoTo:
    """Operator: fly to one point.

    Attributes:
        position: [m], world frame, shape (3,).
        yaw: [rad].
        mission_id: Names the mission that it is on board; 0 for not at all.
    """

    position: Vector
    yaw: float = 0.0
    mission_id: int = 0


@dataclass(frozen=True, slots=True)
class EmergencyStop:
    """Operator: rotors off, at once, whatever the robot does."""


@dataclass(frozen=True, slots=True)
class Acknowledge:
    """Operator: I have seen why the robot landed or was stopped; it may fly again."""


@dataclass(frozen=True, slots=True)
class Pause:
    """Teleop itself, before it ends: let the robot hold until a successor goes on."""


Verb: TypeAlias = (
    StartMission | Continue | Hold | Resume | Cancel | GoTo | EmergencyStop | Acknowledge | Pause
)
"""What an operator can say; `Continue` and `Pause` are for teleop alone."""

Output: TypeAlias = Setpoint | OperatorRequest | MissionEvent
"""What teleop says."""


class State(IntEnum):
    """Where the mission is."""

    IDLE = 0
    """None has been started yet."""
    STARTING = 1
    """The robot has been asked to start and has not been seen to obey."""
    FLYING = 2
    """On the way to a waypoint."""
    HELD = 3
    """Under way, but the operator has stopped it."""
    DONE = 4
    """Every waypoint was reached."""
    FAILED = 5
    """It could not be finished; the outcome says why."""
    CANCELLED = 6
    """The operator ended it."""


@dataclass(frozen=True, slots=True)
class Outcome:
    """How a mission ended.

    Attributes:
        code: "done", "cancelled", "leg_timed_out", "timed_out", "world_restarted",
            "guard_stopped", "emergency_stopped", "taken_over" or "end_lost".
        text: The same in words.
        waypoint: Index of the waypoint that was flown to at the end.
        reached: Number of waypoints reached.
    """

    code: str
    text: str
    waypoint: int
    reached: int

    @property
    def success(self) -> bool:
        """True if every waypoint was reached."""
        return self.code == "done"


Message: TypeAlias = Seen | Output
"""What goes through the sockets: `Seen` to teleop, the others to cloud."""

ALARM = OperatorRequest(0, Request.ESTOP)
"""An emergency stop that passes teleop's own machine by; cloud gives it its number."""

_LEAST, _MOST = -(2**63), 2**63 - 1
_KINDS: dict[str, TypeAdapter[Any]] = {
    kind.__name__: TypeAdapter(kind) for kind in (Seen, Setpoint, OperatorRequest, MissionEvent)
}


def encode(message: Message) -> bytes:
    """Write a message as one datagram."""
    return json.dumps([type(message).__name__, message]).encode()


def decode(data: bytes) -> Message:
    """Read a message from its datagram.

    Raises:
        ValueError: If it is not one, or says what cannot be recorded, or told to the robot.
    """
    try:
        name, fields = json.loads(data)
        message: Message = _KINDS[name].validate_python(fields)
        _check_ranges(message)
    except (ValidationError, ValueError, TypeError, KeyError, RecursionError) as error:
        raise ValueError(f"not a message of teleop: {data[:60]!r}") from error
    return message


def _check_ranges(message: Message) -> None:
    """Let pass what a recording, and of a request what the tunnel, has room for.

    Its number may be higher than the tunnel's: of these cloud keeps count as it drops them.

    Raises:
        ValueError: If a value does not fit.
    """
    fits = all(_LEAST <= value <= _MOST for value in message if isinstance(value, int))
    if isinstance(message, OperatorRequest):
        least = min(message.number, message.mission_id, message.reached)
        fits = fits and least >= 0 and message.reached <= MISSION_OVER
    if not fits:
        raise ValueError("out of range")
