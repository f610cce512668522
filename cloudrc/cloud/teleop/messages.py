"""The messages of teleop: what it is told by cloud and operator, and what it says about a mission.

What it tells the others is defined elsewhere: `Setpoint` to the controller and `OperatorRequest`
to the robot in `cloudrc.messages`, `MissionEvent` to the recorder in `cloudrc.records`.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import IntEnum
from math import nan
from typing import NamedTuple, TypeAlias

from cloudrc.cloud.teleop.plan import Plan
from cloudrc.messages import Cause, GuardState, OperatorRequest, Setpoint, Vector
from cloudrc.records import MissionEvent


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
