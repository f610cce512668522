"""Define teleop's messages; encode the messages between the processes of cloud and teleop.

Teleop gets `RobotStatus` from cloud and verbs from the operator. It sends `Setpoint` to the
controller, `OperatorRequest` to the robot and `MissionEvent` to the recorder.

Each datagram between the processes is a JSON list: the name of the message's type and its fields in
order. Teleop and cloud check every datagram, because other programs could write to the socket.
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
    """One waypoint and the conditions for reaching it.

    Attributes:
        position: Waypoint [m], world frame, shape (3,).
        yaw: Heading to hold [rad].
        tolerance: Largest distance from the waypoint that counts as reached [m]. If the tolerance
            is infinite, the leg always lasts `dwell`; missions of random steps use this.
        dwell: Time to stay within the tolerance without interruption [s].
        time_limit: Longest duration of the leg, without the time in which it is held [s].
    """

    position: Vector
    yaw: float = 0.0
    tolerance: float = 0.10
    dwell: float = 0.5
    time_limit: float = 60.0

    def __post_init__(self) -> None:
        """Check the values.

        Raises:
            BadInputError: If a value is not a number or out of range.
        """
        if not all(map(isfinite, (*self.position, self.yaw))):
            raise BadInputError(f"waypoint {self.position}, yaw {self.yaw}: must be finite")
        if isnan(self.tolerance) or self.tolerance <= 0:
            raise BadInputError(f"waypoint tolerance {self.tolerance} m: must be above 0")
        if not (isfinite(self.dwell) and self.dwell >= 0):
            raise BadInputError(f"waypoint dwell {self.dwell} s: must be finite and >= 0")
        if not (isfinite(self.time_limit) and self.time_limit > 0):
            raise BadInputError(f"time limit {self.time_limit} s: must be finite and above 0")


@dataclass(frozen=True, slots=True)
class Plan:
    """The plan of a mission.

    Attributes:
        legs: Legs to fly, in order; at least one.
        start: Place of the start: the spawn (world is reset), or the robot's position.
        time_limit: Longest duration of the mission, including the time in which it is held [s].
    """

    legs: tuple[Leg, ...]
    start: Start = Start.SPAWN
    time_limit: float = 60.0

    def __post_init__(self) -> None:
        """Check the values.

        Raises:
            BadInputError: If there is no leg, or if the limit is out of range.
        """
        if not self.legs:
            raise BadInputError("a mission needs at least one waypoint")
        if not (isfinite(self.time_limit) and self.time_limit > 0):
            raise BadInputError(f"time limit {self.time_limit} s: must be finite and above 0")


NO_PLAN = Plan((Leg(ZERO),))
"""Placeholder for the plan before the first mission; it is never flown."""


class RobotStatus(NamedTuple):
    """The robot's status from the newest telemetry, sent from cloud to teleop.

    Attributes:
        epoch: Epoch of the session.
        position: Measured position of the base [m], world frame, shape (3,).
        guard: State of the guard.
        mission: Number of the last operator request that world has acted on; 0 if none. (The
            number of the mission is `mission_id`.)
        world: Text that identifies world's process; it changes when world restarts. A restart of
            cloud changes only the epoch.
        pipe_contacts: Number of contacts with pipes so far.
        touch_speed: Speed of the arm's tip when it touched the board [m/s]; NaN before that.
        slip_ns: Lag of world's clock behind its machine's clock [ns].
        horizon: Prediction horizon of cloud [s]; NaN before its first command.
        rtt: Last round trip [s], without the hold time, for which world held the command's stamp
            before it sent the echo; NaN before the first round trip.
        loop_delay: Last `now - echo_stamp` [s], including the hold time; NaN before the first
            round trip.
        mission_id: Number of the mission of the last start request; 0 if none.
        reached: Number of waypoints of this mission that world has stored as reached, or
            `MISSION_OVER`.
        cause: Cause of the guard's state.
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
class Continue:
    """State of a mission that was under way before a restart of teleop.

    Attributes:
        plan: Plan of the mission.
        leg: Index of the current waypoint.
        elapsed: Duration of the mission so far [s].
        world: World in which the mission was flown; in another world it fails.
        held: Whether the operator held the mission.
        mission_id: Number of the mission.
    """

    plan: Plan
    leg: int
    elapsed: float
    world: str
    held: bool = False
    mission_id: int = 0


Output: TypeAlias = Setpoint | OperatorRequest | MissionEvent
"""Messages from teleop."""


class State(IntEnum):
    """State of the mission."""

    IDLE = 0
    """No mission has been started yet."""
    STARTING = 1
    """Teleop has requested the start; telemetry does not show the start yet."""
    FLYING = 2
    """The robot flies to a waypoint."""
    HELD = 3
    """The operator holds the mission."""
    DONE = 4
    """Every waypoint was reached."""
    FAILED = 5
    """The mission failed; the outcome says why."""
    CANCELLED = 6
    """The operator ended the mission."""


@dataclass(frozen=True, slots=True)
class Outcome:
    """How a mission ended.

    Attributes:
        code: "done", "cancelled", "leg_timed_out", "timed_out", "world_restarted",
            "guard_stopped", "emergency_stopped", "taken_over" or "end_lost".
        text: Description of the outcome.
        reached: Number of reached waypoints.
    """

    code: str
    text: str
    reached: int

    @property
    def success(self) -> bool:
        """Whether every waypoint was reached."""
        return self.code == "done"


Message: TypeAlias = RobotStatus | Output
"""Messages between the processes: `RobotStatus` to teleop, the others to cloud."""

ALARM = OperatorRequest(0, Request.ESTOP)
"""Emergency stop; it does not wait for teleop's state machine, and cloud gives it a number."""

_INT_MIN, _INT_MAX = -(2**63), 2**63 - 1
_KINDS: dict[str, TypeAdapter[Any]] = {
    kind.__name__: TypeAdapter(kind)
    for kind in (RobotStatus, Setpoint, OperatorRequest, MissionEvent)
}


def encode(message: Message) -> bytes:
    """Encode a message as one datagram."""
    return json.dumps([type(message).__name__, message]).encode()


def decode(data: bytes) -> Message:
    """Decode a message from its datagram.

    Raises:
        ValueError: If the data are not a message, or if a value does not fit into a recording or a
            datagram.
    """
    try:
        name, fields = json.loads(data)
        message: Message = _KINDS[name].validate_python(fields)
        _check_ranges(message)
    except (ValidationError, ValueError, TypeError, KeyError, RecursionError) as error:
        raise ValueError(f"not a message of teleop: {data[:60]!r}") from error
    return message


def _check_ranges(message: Message) -> None:
    """Check that integers fit into a recording, and integers of a request also into the tunnel.

    Exception: the number of a request may be too high for the tunnel. Cloud counts and drops such a
    request.

    Raises:
        ValueError: If a value does not fit.
    """
    fits = all(_INT_MIN <= value <= _INT_MAX for value in message if isinstance(value, int))
    if isinstance(message, OperatorRequest):
        least = min(message.number, message.mission_id, message.reached)
        fits = fits and least >= 0 and message.reached <= MISSION_OVER
    if not fits:
        raise ValueError("out of range")
