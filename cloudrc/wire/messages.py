# SPDX-License-Identifier: Apache-2.0

"""The messages between world, cloud and teleoperation.

Messages are named tuples in SI units; creating a frozen dataclass would take four times as long.

- Stamps: integer nanoseconds on the monotonic clock of world or cloud, as stated. Only stamps of
  the same clock may be subtracted.
- Frames: REP-103 (x forward, y left, z up). A vector is in the world frame unless its name ends in
  ``_body``.
- Quaternions: ``wxyz``, as in MuJoCo.
- ``Annotated[float, "s", "text"]``: a value in a topic of the recording, with its unit ("": none)
  and its meaning.
"""

from __future__ import annotations

from enum import IntEnum
from math import nan
from typing import Annotated, Any, NamedTuple, TypeAlias

Vector: TypeAlias = tuple[float, float, float]
Quaternion: TypeAlias = tuple[float, float, float, float]

ZERO: Vector = (0.0, 0.0, 0.0)
UPRIGHT: Quaternion = (1.0, 0.0, 0.0, 0.0)
NEVER_NS = -1
"""Stamp that stands for "never" [ns]."""
FRESH_ECHO_PERIODS = 5
"""Longest hold time of an echo that gives a delay sample [command periods]. While no commands reach
world, the hold time grows although the delay of the link does not change."""


class GuardState(IntEnum):
    """State of the guard."""

    GROUND = 0
    """The robot is switched off. The state ends when the operator starts a mission."""
    TRACK = 1
    """The robot follows fresh commands from the cloud."""
    HOLD = 2
    """No command is fresh: the robot brakes, then holds its position with onboard sensors only."""
    LAND = 3
    """The robot descends slowly and switches off at touch-down. LAND lasts until the operator
    acknowledges."""
    ESTOP = 4
    """The robot was switched off at once. ESTOP lasts until the operator acknowledges."""


class Cause(IntEnum):
    """Why the guard is in its state: messages carry the number, and users read the `words`."""

    words: str

    def __new__(cls, number: int, words: str) -> Cause:
        """Make a cause from its number and the words that describe it."""
        cause = int.__new__(cls, number)
        cause._value_, cause.words = number, words
        return cause

    SPAWN = 0, "at its spawn"
    COMMAND = 1, "fresh command"
    COMMANDS = 2, "fresh commands again"
    SILENCE = 3, "no fresh commands"
    SESSION = 4, "new session"
    ENDED = 5, "mission ended"
    ALONE = 6, "held too long without the cloud"
    IMPOSSIBLE = 7, "impossible commands"
    STOPPED = 8, "emergency stop"
    OVERTURNED = 9, "turned over"
    ACKNOWLEDGED = 10, "acknowledged"
    STILL_FIRST = 11, "acknowledged, starts once it has been still, inside the fence"
    NOT_DOWN = 12, "acknowledged before touch-down"
    DOWN = 13, "at rest, switched off"
    NOT_OFF = 14, "not off the ground yet, switched off"
    FAILED = 15, "onboard controller failed"


STATES = ", ".join(f"{state:d} {state.name}" for state in GuardState)
CAUSES = "of the guard's state: " + "; ".join(f"{cause:d} {cause.words}" for cause in Cause)
"""The values of `GuardState` and of `Cause`, in words."""
Slip: TypeAlias = Annotated[int, "ns", "lag of world's clock behind the machine's monotonic clock"]
MISSION_OVER = 0xFFFF
"""Value of `reached` for a mission that has ended, above the largest number of waypoints."""


class Start(IntEnum):
    """Place where a mission starts."""

    SPAWN = 0
    """World resets the robot to its spawn point and begins a new session (epoch)."""
    HERE = 1
    """The robot starts from its present place."""


class Request(IntEnum):
    """A request of the operator to the robot."""

    START = 0
    """Arm the robot and begin the mission."""
    END = 1
    """End the mission: the robot holds its position until the next mission starts."""
    ESTOP = 2
    """Switch the robot off at once, in any state. ESTOP lasts until the operator acknowledges."""
    ACKNOWLEDGE = 3
    """End the state LAND or ESTOP; the operator has seen its cause. It stays switched off."""
    PROGRESS = 4
    """Store the mission's progress on board, for a cloud that restarts. The request number is 0."""


class Odometry(NamedTuple):
    """Measured or true pose and twist of the robot's base at one time."""

    stamp_ns: int  # time of the measurement [ns], world's clock
    position: Annotated[Vector, "m", "of the base, world frame"]
    orientation_wxyz: Annotated[Quaternion, "1", "of the base, body to world"]
    velocity: Annotated[Vector, "m/s", "of the base, world frame"]
    angular_velocity_body: Annotated[Vector, "rad/s", "of the base, body frame"]


SENSORS_MAX = 16
"""Largest number of a robot's own sensors."""


class Telemetry(NamedTuple):
    """Message from world to cloud, at 100 Hz.

    Cloud computes the round trip from the echo: the stamp of the newest applied command, and the
    time since world first applied it.
    """

    stamp_ns: Annotated[int, "ns", "stamp of its odometry, world's clock"]
    odometry: Odometry  # measured pose and twist, with sensor noise if configured
    sensors: tuple[float, ...]  # of the robot's own sensors, in the order of `robot.yaml`
    echo_stamp_ns: Annotated[
        int, "ns", "stamp of the newest command applied, cloud's clock; -1 if none"
    ]
    echo_hold_ns: Annotated[int, "ns", "time since world applied that command; 0 if none"]
    slip_ns: Slip
    mission: Annotated[int, "", "number of the last operator's request that world obeyed"]
    guard: Annotated[GuardState, "", STATES]
    obstacle_contacts: Annotated[int, "", "contacts with obstacles that began in this mission"] = 0
    touch_speed: Annotated[float, "m/s", "of the mission's first touch, or NaN"] = nan
    mission_id: Annotated[int, "", "identity of the mission started last; 0 if none"] = 0
    reached: Annotated[int, "", f"waypoints reached; {MISSION_OVER} if the mission is over"] = 0
    cause: Annotated[Cause, "", CAUSES] = Cause.SPAWN  # after touch-down in LAND, of the landing


RAYS_MAX = 541
"""Largest number of rays of a scan: one datagram holds them."""


class RangeScan(NamedTuple):
    """Message from world to cloud: the distances that a scanner measured at one time."""

    stamp_ns: int  # time of the measurement [ns], world's clock
    millimetres: tuple[int, ...]  # a distance per ray, from right to left; 0: nothing within range


FRAGMENT_MAX = 1151
"""Largest fragment of a picture: with header and tag its datagram has 1,200 bytes [bytes]."""


class Fragment(NamedTuple):
    """Message from world to cloud: a part of an encoded picture of the robot's camera."""

    stamp_ns: int  # time at which the picture was taken [ns], world's clock
    number: int  # of the picture in its session, from 0 on
    fragment: int  # its number in the picture, from 0 on
    fragments: int  # of which the picture consists
    key: bool  # whether the picture needs none before it
    data: bytes


PLAN_STEP_NS = 10_000_000
"""Time between two velocities of a plan [ns]."""


def plan_length(duration: float) -> int:
    """Return the number of velocities in a plan of `duration` [s]."""
    return round(duration * 1e9) // PLAN_STEP_NS


class Command(NamedTuple):
    """Message from cloud to world, at 100 Hz; it may contain a plan of future velocities.

    The plan begins at the time for which cloud predicted the robot's state, even if the command
    arrives later.
    """

    stamp_ns: int  # time of the computation [ns], cloud's clock
    basis_stamp_ns: int  # stamp of the odometry that the command is based on [ns], world's clock
    basis_hold_ns: int  # time from the arrival of this odometry at cloud to the computation [ns]
    velocity: Vector  # commanded velocity [m/s]
    yaw_rate: float  # commanded yaw rate [rad/s]
    plan: tuple[Vector, ...] = ()  # velocities after `velocity` [m/s], one per PLAN_STEP_NS
    planned_ns: int = NEVER_NS  # with a plan: time at which it begins [ns], world's clock

    def velocity_at(self, now_ns: int) -> Vector:
        """Return the commanded velocity [m/s] at `now_ns` [ns], world's clock.

        Before the plan begins, return `velocity`; after its end, the last velocity of the plan.
        """
        step = (now_ns - self.planned_ns) // PLAN_STEP_NS
        if step <= 0 or not self.plan:
            return self.velocity
        return self.plan[min(step, len(self.plan)) - 1]


TOUCH_NAME_MAX = 64
"""Largest size of the name of a body to touch [bytes in UTF-8]; a datagram has room for it."""


class OperatorRequest(NamedTuple):
    """Request of the operator to the robot; cloud repeats it until telemetry shows its number."""

    number: int  # higher than the numbers of all requests that the robot has carried out
    request: Request
    start: Start = Start.SPAWN  # where the mission starts; only for `Request.START`
    mission_id: int = 0  # number of the mission, below 2^63
    reached: int = 0  # waypoints reached in the mission; `MISSION_OVER` if it ended early
    # Stamp of cloud's newest odometry when cloud forwarded the request [ns], world's clock.
    basis_stamp_ns: int = NEVER_NS
    epoch: int = 0  # session that teleop saw when it made the request, for cloud only; 0 for none
    # Name of the body that the mission has to touch, which is no obstacle; "": none. START only.
    touch: str = ""


class Motion(NamedTuple):
    """Straight motion of a setpoint, from rest to rest; `teleop.carrot` computes it."""

    start: Vector  # position at the beginning [m]
    begin_ns: int  # time of the beginning [ns], the monotonic clock of cloud's machine
    speed: float  # largest speed [m/s], > 0
    acceleration: float  # acceleration and deceleration [m/s^2], > 0


class Drive(NamedTuple):
    """Motion of a setpoint that is driven by hand; `teleop.carrot` computes it.

    The setpoint changes its velocity to `target`, keeps it, and brakes to rest from `until_ns` on.
    """

    start: Vector  # position at the beginning [m]
    begin_ns: int  # time of the beginning [ns], the monotonic clock of cloud's machine
    velocity: Vector  # velocity at the beginning [m/s]
    target: Vector  # velocity to take up [m/s]
    acceleration: float  # acceleration and deceleration [m/s^2], > 0
    until_ns: int  # time at which the setpoint begins to brake [ns], the clock of `begin_ns`
    low: Vector  # the setpoint stays in the box from this corner [m], world frame
    high: Vector  # to this one [m], world frame
    yaw_rate: float = 0.0  # of the heading until `until_ns` [rad/s]


class Setpoint(NamedTuple):
    """Target that teleop gives to the controller."""

    position: Vector  # target position [m]; the end of `motion`
    yaw: float = 0.0  # target heading [rad]
    waypoint: int = -1  # index of the waypoint in the mission; -1 for none
    epoch: int = 0  # session for which teleop made the setpoint; 0 for none
    velocity: Vector = ZERO  # velocity of the target [m/s]
    motion: Motion | Drive | None = None  # how the target moves; None: it rests
    turns: bool = False  # whether the robot has to turn to `yaw`; else it keeps its heading
    yaw_rate: float = 0.0  # of the target [rad/s]


class Passed(NamedTuple):
    """Datagram to an endpoint in the same process; to save time, the message is not encoded."""

    kind: int  # a `tunnel.codec.Kind`
    epoch: int
    counter: int  # of the datagram
    message: Any  # the object itself, not a copy
    size: int  # of the datagram that it would be [bytes]


Datagram: TypeAlias = Any
"""What an endpoint sends: bytes, or a `Passed` message if its `Identity` has `passes`."""
