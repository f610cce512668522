"""The messages between world, cloud and teleoperation.

Messages are named tuples in SI units; to make a frozen dataclass takes four times as long.

- Stamps: integer nanoseconds on the monotonic clock of world or cloud, as stated. Only stamps of
  the same clock may be subtracted.
- Frames: REP-103 (x forward, y left, z up). A vector is in the world frame unless its name ends in
  ``_body``.
- Quaternions: ``wxyz``, as in MuJoCo.
"""

from __future__ import annotations

from enum import IntEnum
from math import nan
from typing import Any, NamedTuple, TypeAlias

Vector: TypeAlias = tuple[float, float, float]
Quaternion: TypeAlias = tuple[float, float, float, float]

ZERO: Vector = (0.0, 0.0, 0.0)
UPRIGHT: Quaternion = (1.0, 0.0, 0.0, 0.0)
NEVER_NS = -1
"""Stamp that stands for "never" [ns]."""


class GuardState(IntEnum):
    """State of the guard."""

    GROUND = 0
    """The rotors are stopped. The state ends when the operator starts a mission."""
    TRACK = 1
    """The robot follows fresh commands from the cloud."""
    HOLD = 2
    """No command is fresh: the robot brakes, then holds its position with onboard sensors only."""
    LAND = 3
    """The robot descends slowly and stops its rotors at touch-down. LAND lasts until the operator
acknowledges."""
    ESTOP = 4
    """The rotors were stopped at once. ESTOP lasts until the operator acknowledges."""


class Cause(IntEnum):
    """Why the guard is in its state: a number in messages, and `words` for users."""

    words: str

    def __new__(cls, number: int, words: str) -> Cause:
        """Make a cause from its number and its words."""
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
    STILL_FIRST = 11, "acknowledged, takes off once it has been still, 0.5 m inside the fence"
    NOT_DOWN = 12, "acknowledged before touch-down"
    DOWN = 13, "touched down, rotors stopped"
    NOT_OFF = 14, "not off the ground yet, rotors stopped"


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
    """Stop the rotors at once, in any state. ESTOP lasts until the operator acknowledges."""
    ACKNOWLEDGE = 3
    """End the state LAND or ESTOP; the operator has seen its cause. Stopped rotors stay stopped."""
    PROGRESS = 4
    """Store the mission's progress on board, for a cloud that restarts. The request number is 0."""


class Odometry(NamedTuple):
    """Measured or true pose and twist of the robot's base at one time.

    Attributes:
        stamp_ns: Time of the measurement [ns], world's clock.
        position: Position of the base [m], world frame, shape (3,).
        orientation_wxyz: Orientation of the base, unit quaternion, body to world, shape (4,).
        velocity: Velocity of the base [m/s], world frame, shape (3,).
        angular_velocity_body: Angular velocity of the base [rad/s], body frame, shape (3,).
    """

    stamp_ns: int
    position: Vector
    orientation_wxyz: Quaternion
    velocity: Vector
    angular_velocity_body: Vector


class Telemetry(NamedTuple):
    """Message from world to cloud, at 100 Hz.

    Attributes:
        stamp_ns: Stamp of the odometry [ns], world's clock.
        odometry: Measured pose and twist, with sensor noise if configured.
        tip_force: Force on the touch sensor at the arm's tip [N].
        echo_stamp_ns: Stamp of the newest applied command [ns], cloud's clock; `NEVER_NS` if none.
            Cloud computes the round trip from this value.
        echo_hold_ns: Time since world first applied the newest applied command [ns].
        slip_ns: Lag of world's clock behind its machine's monotonic clock [ns].
        mission: Number of the last operator request that world carried out; 0 if none.
        guard: State of the guard.
        pipe_contacts: Number of contacts with pipes in this mission.
        touch_speed: Speed of the tip at its first contact with the board in this mission [m/s]; NaN
            before the first contact.
        mission_id: Mission that was started last, as in `OperatorRequest`; 0 if none.
        reached: Number of waypoints reached in this mission, as far as world knows, or
            `MISSION_OVER`.
        cause: Why the guard is in its state; after touch-down in LAND, why the robot landed.
    """

    stamp_ns: int
    odometry: Odometry
    tip_force: float
    echo_stamp_ns: int
    echo_hold_ns: int
    slip_ns: int
    mission: int
    guard: GuardState
    pipe_contacts: int = 0
    touch_speed: float = nan
    mission_id: int = 0
    reached: int = 0
    cause: Cause = Cause.SPAWN


PLAN_STEP_NS = 10_000_000
"""Time between two velocities of a plan [ns]."""


def plan_length(duration: float) -> int:
    """Return the number of velocities in a plan of `duration` [s]."""
    return round(duration * 1e9) // PLAN_STEP_NS


class Command(NamedTuple):
    """Message from cloud to world, at 100 Hz; it may contain a plan of future velocities.

    The plan belongs to the time for which cloud predicted the robot's state. World plays it on this
    time line, however late the command arrives.

    Attributes:
        stamp_ns: Time of the computation [ns], cloud's clock.
        basis_stamp_ns: Stamp of the odometry that the command is based on [ns], world's clock.
        basis_hold_ns: Time from the arrival of this odometry at cloud to the computation [ns].
        velocity: Commanded velocity [m/s], world frame, shape (3,).
        yaw_rate: Commanded yaw rate [rad/s].
        plan: Velocities [m/s] after `velocity`, one per PLAN_STEP_NS, world frame, shape (n, 3).
        planned_ns: Time for which `velocity` was computed [ns], world's clock; used with a plan.
    """

    stamp_ns: int
    basis_stamp_ns: int
    basis_hold_ns: int
    velocity: Vector
    yaw_rate: float
    plan: tuple[Vector, ...] = ()
    planned_ns: int = NEVER_NS

    def velocity_at(self, now_ns: int) -> Vector:
        """Return the commanded velocity at `now_ns` [ns], world's clock; after the plan, its last.

        Before `planned_ns`, it is the first.
        """
        step = (now_ns - self.planned_ns) // PLAN_STEP_NS
        if step <= 0 or not self.plan:
            return self.velocity
        return self.plan[min(step, len(self.plan)) - 1]


MISSION_OVER = 0xFFFF
"""Value of `reached` for a mission that has ended; no mission has so many waypoints."""


class OperatorRequest(NamedTuple):
    """Request of the operator to the robot; cloud repeats it until telemetry shows its number.

    Attributes:
        number: Request number, higher than those of all requests that the robot has carried out.
        request: Kind of the request.
        start: Where the mission starts; only for `Request.START`.
        mission_id: Number of the mission, below 2^63.
        reached: Number of waypoints reached in the mission; `MISSION_OVER` if it ended early.
        basis_stamp_ns: Stamp of cloud's newest odometry when cloud forwarded the request [ns],
            world's clock; `NEVER_NS` before the first odometry.
        epoch: Session that teleop saw when it made the request; 0 for none. Only cloud uses it.
    """

    number: int
    request: Request
    start: Start = Start.SPAWN
    mission_id: int = 0
    reached: int = 0
    basis_stamp_ns: int = NEVER_NS
    epoch: int = 0


class Motion(NamedTuple):
    """Straight motion of a setpoint, from rest to rest; `teleop.carrot` computes it.

    Attributes:
        start: Position at the beginning [m], world frame, shape (3,).
        begin_ns: Time of the beginning [ns], the monotonic clock of cloud's machine.
        speed: Largest speed [m/s], > 0.
        acceleration: Acceleration and deceleration [m/s^2], > 0.
    """

    start: Vector
    begin_ns: int
    speed: float
    acceleration: float


class Drive(NamedTuple):
    """Motion of a setpoint that is driven by hand; `teleop.carrot` computes it.

    The setpoint changes its velocity to `target`, keeps it, and brakes to rest from `until_ns` on.

    Attributes:
        start: Position at the beginning [m], world frame, shape (3,).
        begin_ns: Time of the beginning [ns], the monotonic clock of cloud's machine.
        velocity: Velocity at the beginning [m/s], world frame, shape (3,).
        target: Velocity to take up [m/s], world frame, shape (3,).
        acceleration: Acceleration and deceleration [m/s^2], > 0.
        until_ns: Time at which the setpoint begins to brake [ns], the clock of `begin_ns`.
    """

    start: Vector
    begin_ns: int
    velocity: Vector
    target: Vector
    acceleration: float
    until_ns: int


class Setpoint(NamedTuple):
    """Target that teleop gives to the controller.

    Attributes:
        position: Target position [m], world frame, shape (3,); the end of `motion`.
        yaw: Target heading [rad].
        waypoint: Index of the waypoint in the mission; -1 for none.
        epoch: Session for which teleop made the setpoint; 0 for none.
        velocity: Velocity of the target [m/s], world frame, shape (3,).
        motion: How the target moves; None: it rests.
    """

    position: Vector
    yaw: float = 0.0
    waypoint: int = -1
    epoch: int = 0
    velocity: Vector = ZERO
    motion: Motion | Drive | None = None


class Passed(NamedTuple):
    """A message that stays in one process, in place of a datagram with `message` as its body.

    Attributes:
        kind: Kind of the datagram, a `tunnel.codec.Kind`.
        epoch: Number of the session.
        counter: Counter of the datagram.
        message: The message; the receiver uses this object itself.
    """

    kind: int
    epoch: int
    counter: int
    message: Any


Datagram: TypeAlias = Any
"""What an end sends: bytes, or a `Passed` message where an `Identity` asks for it."""
