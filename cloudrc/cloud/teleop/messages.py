"""The messages of teleop: what it is told by cloud and operator, and what it says about a mission.

What it tells the others is defined elsewhere: `Setpoint` to the controller and `OperatorRequest`
to the robot in `cloudrc.messages`, `MissionEvent` to the recorder in `cloudrc.records`.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import IntEnum
from typing import NamedTuple, TypeAlias

from cloudrc.cloud.teleop.plan import Plan
from cloudrc.messages import GuardState, OperatorRequest, Setpoint, Vector
from cloudrc.records import MissionEvent


class Seen(NamedTuple):
    """What the newest telemetry says, as it arrives: cloud to teleop.

    Attributes:
        epoch: Session that it belongs to.
        position: Measured, of the base [m], world frame, shape (3,).
        guard: State of the guard.
        mission: Number of the last operator request that world has acted on; 0 if none.
    """

    epoch: int
    position: Vector
    guard: GuardState
    mission: int


@dataclass(frozen=True, slots=True)
class StartMission:
    """Operator: fly this plan."""

    plan: Plan


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
    """

    position: Vector
    yaw: float = 0.0


Verb: TypeAlias = StartMission | Hold | Resume | Cancel | GoTo
"""What an operator can say."""

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
        code: "done", "cancelled", "leg_timed_out", "timed_out", "world_restarted" or
            "guard_stopped".
        text: The same in words.
        waypoint: Index of the waypoint that was flown to at the end.
    """

    code: str
    text: str
    waypoint: int

    @property
    def success(self) -> bool:
        """True if every waypoint was reached."""
        return self.code == "done"
