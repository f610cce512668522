"""The messages of the loop: what the two ends tell each other and what they record.

Named tuples in SI units: they cannot be changed, and one is made in a quarter of the time that a
frozen dataclass takes, which counts where a dozen are made in every 10 ms of flight. Every stamp
is an integer number of nanoseconds on the monotonic clock of the end that is named beside it; two
stamps may be subtracted only if they are of one clock. Frames: REP-103 (x forward, y left, z up);
unmarked vectors are in the world frame, the others end in ``_body``. Quaternions are ``wxyz``, as
in MuJoCo.
"""

from __future__ import annotations

from enum import IntEnum
from math import nan
from typing import NamedTuple, TypeAlias

Vector: TypeAlias = tuple[float, float, float]
Quaternion: TypeAlias = tuple[float, float, float, float]

ZERO: Vector = (0.0, 0.0, 0.0)
UPRIGHT: Quaternion = (1.0, 0.0, 0.0, 0.0)
NEVER_NS = -1
"""The stamp of something that has not happened yet."""


class GuardState(IntEnum):
    """What the guard on board lets the robot do."""

    GROUND = 0
    """Rotors stopped; only an operator's start of a mission leads out."""
    TRACK = 1
    """Fresh commands from the cloud are flown."""
    HOLD = 2
    """No fresh command: brake, then hold the position with onboard sensing alone."""
    LAND = 3
    """Slow descent, rotors stopped once it has touched down; latched until acknowledged."""
    ESTOP = 4
    """Rotors stopped at once; latched until acknowledged."""


class Cause(IntEnum):
    """Why the guard is in its state: a number on the wire, `words` for whoever reads."""

    words: str

    def __new__(cls, number: int, words: str) -> Cause:
        """Make a member of its number; the words come along."""
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
    SPUN = 10, "spun round by a hit"
    JOLTED = 11, "jolted by a hit"
    ACKNOWLEDGED = 12, "acknowledged"
    STILL_FIRST = 13, "acknowledged, takes off once it has been still, 0.5 m inside the fence"
    NOT_DOWN = 14, "acknowledged before touch-down"
    DOWN = 15, "touched down, rotors stopped"
    NOT_OFF = 16, "not off the ground yet, rotors stopped"


class Start(IntEnum):
    """Where a mission starts from."""

    SPAWN = 0
    """The world is reset to its spawn under a new epoch."""
    HERE = 1
    """The robot goes on from where it is."""


class Request(IntEnum):
    """What the operator asks of the robot itself."""

    START = 0
    """Begin the mission: arm."""
    END = 1
    """The mission is over: hold locally until the next one starts."""
    ESTOP = 2
    """Stop the rotors at once, whatever the robot does; latched until acknowledged."""
    ACKNOWLEDGE = 3
    """The operator has seen why the robot lands or was stopped, and releases it; arms nothing."""
    PROGRESS = 4
    """Keep in mind how far the mission is, for a cloud that forgets: no number, no effect else."""


class Odometry(NamedTuple):
    """Pose and twist of the robot's base at one instant.

    Attributes:
        stamp_ns: Instant of the measurement [ns], world's clock.
        position: Of the base [m], world frame, shape (3,).
        orientation_wxyz: Of the base, unit quaternion, body to world, shape (4,).
        velocity: Of the base [m/s], world frame, shape (3,).
        angular_velocity_body: Of the base [rad/s], body frame, shape (3,).
    """

    stamp_ns: int
    position: Vector
    orientation_wxyz: Quaternion
    velocity: Vector
    angular_velocity_body: Vector


class Telemetry(NamedTuple):
    """What world sends to cloud at 100 Hz.

    Attributes:
        stamp_ns: That of the odometry [ns], world's clock.
        odometry: Measured pose and twist, with sensor noise if there is any.
        tip_force: Force on the touch sensor at the arm's tip [N].
        echo_stamp_ns: Stamp of the newest command applied [ns], cloud's clock; NEVER_NS if none.
        echo_hold_ns: How long world has held that command [ns].
        slip_ns: By how much world's clock lags its machine's monotonic clock [ns].
        mission: Number of the last mission request that world has acted on; 0 if none.
        guard: State of the guard.
        pipe_contacts: How often the robot has begun to touch a pipe in this mission.
        touch_speed: Of the tip when it first touched the board in this mission [m/s]; NaN if it has
            not yet.
        mission_id: The mission started last, as OperatorRequest named it; 0 if none.
        reached: How many of its waypoints world has been told are reached, or `MISSION_OVER`.
        cause: Why the guard is in its state; of one that has touched down in LAND, why it landed.
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


class Command(NamedTuple):
    """What cloud sends to world at 100 Hz.

    Attributes:
        stamp_ns: When it was computed [ns], cloud's clock.
        basis_stamp_ns: Stamp of the odometry it was computed from [ns], world's clock.
        basis_hold_ns: How long cloud had held that odometry [ns].
        velocity: Wanted velocity [m/s], world frame, shape (3,).
        yaw_rate: Wanted yaw rate [rad/s].
    """

    stamp_ns: int
    basis_stamp_ns: int
    basis_hold_ns: int
    velocity: Vector
    yaw_rate: float


MISSION_OVER = 0xFFFF
"""In place of a number of waypoints reached: more than any mission has."""


class OperatorRequest(NamedTuple):
    """What the operator asks of the robot itself; repeated until telemetry shows its number.

    Attributes:
        number: Rises with every request of an operator, above what the robot has acted on.
        request: What is asked.
        start: Where the mission starts from; only read with Request.START.
        mission_id: Names the mission, below 2^63.
        reached: How many of its waypoints are reached; `MISSION_OVER` if it has ended before that.
        basis_stamp_ns: When the newest odometry was measured that cloud has had as it passed this
            on [ns, world's clock]; before any, `NEVER_NS`.
        epoch: Session in which the robot was seen when teleop said it; 0 if that was in none. For
            cloud alone: it is not told to the robot.
    """

    number: int
    request: Request
    start: Start = Start.SPAWN
    mission_id: int = 0
    reached: int = 0
    basis_stamp_ns: int = NEVER_NS
    epoch: int = 0


class Setpoint(NamedTuple):
    """What the controller tracks: teleop to controller.

    Attributes:
        position: [m], world frame, shape (3,).
        yaw: [rad].
        waypoint: Index of the mission's waypoint that it belongs to; -1 if it belongs to none.
        epoch: Session in which the robot was seen that it is meant for; 0 if that was in none.
    """

    position: Vector
    yaw: float = 0.0
    waypoint: int = -1
    epoch: int = 0
