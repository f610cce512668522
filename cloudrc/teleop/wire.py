# SPDX-License-Identifier: Apache-2.0

"""Define the plan of a mission, and encode the messages between cloud and teleop.

Each datagram is a JSON list: the name of the message's type, then its fields in order.
"""

from __future__ import annotations

import json
from dataclasses import dataclass
from math import dist, isinf, nan, radians
from typing import Final, Literal, NamedTuple, TypeAlias

from pydantic import TypeAdapter
from pydantic_core import to_json

from cloudrc.base.rounding import exceeds
from cloudrc.config.follow import Follow
from cloudrc.config.schema import YAW_TOLERANCE_DEG, JudgedBy
from cloudrc.physics.geometry.vectors import turn_to
from cloudrc.wire.messages import (
    NEVER_NS,
    UPRIGHT,
    ZERO,
    Cause,
    GuardState,
    OperatorRequest,
    Quaternion,
    Request,
    Setpoint,
    Start,
    Vector,
)
from cloudrc.wire.records import FAILURES, Control, MissionEnd, MissionEvent, MissionState, UnderWay


@dataclass(frozen=True, slots=True)
class Leg:
    """A waypoint, and the conditions under which it counts as reached.

    If `speed` is 0, the robot has to stay there for the time `dwell`. If `speed` is above 0, the
    setpoint has to rest at the waypoint for the time `dwell`; then the robot has to be there. It is
    there within `tolerance`, and within `yaw_tolerance` if the leg has a `yaw`. With an infinite
    `tolerance`, only the time counts.
    """

    position: Vector  # [m], world frame, shape (3,)
    yaw: float | None = None  # heading at the waypoint [rad]; None: any
    tolerance: float = 0.10  # largest distance from the waypoint that counts as reached [m]
    dwell: float = 0.5  # time to stay within the tolerance without interruption [s]
    time_limit: float = 60.0  # for reaching the waypoint, without holds [s]
    speed: float = 0.0  # of the setpoint on its way to the waypoint [m/s]; 0: the setpoint jumps
    acceleration: float = 1.0  # of the setpoint [m/s^2]
    yaw_tolerance: float = radians(YAW_TOLERANCE_DEG)  # largest error of `yaw` when reached [rad]

    def has(self, seen: RobotStatus) -> bool:
        """Return whether a robot is at the waypoint, and has its heading, if it has one."""
        if exceeds(dist(seen.position, self.position), self.tolerance):
            return False
        if self.yaw is None:
            return True
        return not exceeds(abs(turn_to(self.yaw, seen.orientation_wxyz)), self.yaw_tolerance)


@dataclass(frozen=True, slots=True)
class Plan:
    """What a mission flies: its waypoints (`legs`) or its `track`, where it starts, its time limit.

    A track gives setpoints at fixed times. A mission with a track has one leg, which counts as
    reached at the end of the track.
    """

    legs: tuple[Leg, ...]  # in order; at least one
    start: Start = Start.SPAWN  # the spawn (world is reset), or the robot's position
    time_limit: float = 60.0  # of the mission, with holds [s]
    by_hand: bool = False  # whether the mission begins held, for an operator who drives
    track: tuple[
        tuple[float, Vector], ...
    ] = ()  # times [s] and setpoints [m]; none, or two or more
    judged_by: JudgedBy = "measured"  # position that shows that the robot is at a waypoint
    follow: Follow | None = None  # what to keep in view; then the track rests at one place

    @property
    def contents(self) -> str:
        """What the mission flies, in words, such as "waypoints: 7"."""
        if self.track:
            return f"{self.track_name} for {self.track[-1][0]:g} s"
        return f"{self.unit}s: {len(self.legs)}"

    @property
    def track_name(self) -> str:
        """Name of the track."""
        return f"following {self.follow.target}" if self.follow else "setpoints"

    @property
    def waypoints(self) -> tuple[Leg, ...]:
        """The legs, for people; none for a track."""
        return () if self.track else self.legs

    @property
    def unit(self) -> str:
        """Name of each leg: "waypoint", or "step" if only its time counts."""
        return "step" if isinf(self.legs[0].tolerance) else "waypoint"


class RobotStatus(NamedTuple):
    """Status of the robot after the newest telemetry; cloud sends it to teleop.

    Numbers that are not known yet are NaN.
    """

    epoch: int  # number of the session with world; a restart of cloud changes the number
    position: Vector  # measured position of the base [m], world frame, shape (3,)
    guard: GuardState
    mission: int  # number of the last operator request that world has acted on; 0 if none
    world: str = ""  # identifies world's process; a restart of world changes it
    obstacle_contacts: int = 0  # number of contacts with obstacles in the mission
    touch_speed: float = nan  # of the first touch of what the mission has to touch [m/s]
    slip_ns: int = 0  # lag of world's clock behind its machine's clock [ns]
    mission_id: int = 0  # number of the mission of the last start request; 0 if none
    reached: int = 0  # waypoints that world has stored as reached, or `MISSION_OVER`
    cause: Cause = Cause.SPAWN  # why the guard is in its state
    stamp_ns: int = NEVER_NS  # stamp of the telemetry [ns], world's clock
    orientation_wxyz: Quaternion = UPRIGHT  # measured orientation, unit quaternion
    velocity: Vector = ZERO  # measured velocity of the base [m/s], world frame
    command_age_ns: int = NEVER_NS  # age of the last applied command [ns]; `NEVER_NS` if none
    uplink_delay: float = nan  # of the telemetry before `control` [s]; NaN without a common clock
    control: Control | None = None  # last command of the session; None before the first
    sensors: tuple[float, ...] = ()  # of the robot's own sensors, in the order of `robot.yaml`


QUEUED: Final = "queued"
STARTING: Final = "starting"
FLYING: Final = "flying"
HELD: Final = "held"
"""States of a mission that has not ended; STARTING ends when telemetry shows the start."""
ENDED: tuple[MissionState, ...] = ("done", "failed", "cancelled")
"""States of a mission that has ended."""
EventName: TypeAlias = Literal[
    UnderWay,
    MissionEnd,
    "queued",
    "starting",
    "restarted",
    "new_session",
    "no_telemetry",
    "telemetry_again",
    "guard_holds",
    "hold_over",
    "link_changed",
    "touched",
    "obstacle_touched",
]
"""Events in the log of a mission: those of `MissionEvent`, and what teleop alone notes."""
STATES: dict[EventName, MissionState] = {
    "queued": QUEUED,
    "starting": STARTING,
    "started": FLYING,
    "resumed": FLYING,
    "held": HELD,
    "done": "done",
    "cancelled": "cancelled",
    **dict.fromkeys(FAILURES, "failed"),
}
"""Event -> state of the mission after the event; all other events leave the state as it is."""


Output: TypeAlias = Setpoint | OperatorRequest | MissionEvent
"""Messages from teleop to cloud."""
Message: TypeAlias = RobotStatus | Output
ALARM = OperatorRequest(0, Request.ESTOP)
"""Emergency stop without a number. Cloud adds the number, so every part of teleop can send this."""
NO_STATUS = b"null\n"
"""Line of the stream of statuses before the first telemetry."""
_STATUS = TypeAdapter(RobotStatus)
_KINDS: dict[str, TypeAdapter[Message]] = {
    kind.__name__: TypeAdapter(kind)
    for kind in (RobotStatus, Setpoint, OperatorRequest, MissionEvent)
}


def encode(message: Message) -> bytes:
    """Encode a message as one datagram."""
    return to_json([type(message).__name__, message], inf_nan_mode="constants")


def decode(data: bytes) -> Message:
    """Decode a message of `encode`."""
    name, fields = json.loads(data)
    return _KINDS[name].validate_python(fields)


def write_line(status: RobotStatus | None) -> bytes:
    """Encode a status as a line of JSON with the fields' names; unknown numbers become null."""
    if status is None:
        return NO_STATUS
    control = status.control and status.control._asdict()
    return to_json({**status._asdict(), "control": control}, inf_nan_mode="null") + b"\n"


def read_line(line: bytes) -> RobotStatus | None:
    """Decode a line of `write_line`; raise ValueError if it is malformed."""
    if line == NO_STATUS:
        return None
    tree = json.loads(line.replace(b"null", b"NaN"))  # a null is an unknown number, or no command
    if isinstance(tree["control"], float):
        tree["control"] = None
    return _STATUS.validate_python(tree)
