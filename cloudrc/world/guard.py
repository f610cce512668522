"""The guard: between the tunnel and the low-level controller, it decides what may be flown.

Commands and operator requests come in; a velocity reference comes out, every 2 ms. It trusts its
own clock and its own sensors only, and assumes that the cloud may say anything. Here without
latches: HOLD ends as soon as a fresh command arrives. A command is fresh while its *basis*, the
odometry that it was computed from, is at most `command_age_max` old.
"""

from __future__ import annotations

from dataclasses import dataclass
from math import isfinite, sqrt

from cloudrc.messages import NEVER_NS, ZERO, Command, GuardState, Vector
from cloudrc.records import GuardChange
from cloudrc.world.readings import Readings

TRACK = GuardState.TRACK  # looked up in every tick

BRAKE = 3.0
"""Deceleration in HOLD [m/s^2]; the stop rule of the design assumes it."""
HOLD_GAIN = 1.0
"""Of the local position hold [1/s]."""
HOLD_SPEED_MAX = 0.5
"""Of the local position hold [m/s]."""


@dataclass(frozen=True, slots=True)
class Limits:
    """What the guard allows.

    Attributes:
        command_age_max_ns: Age of the basis beyond which a command is not flown [ns].
        speed_max: Largest speed [m/s].
        acceleration_max: Largest change of the reference [m/s^2].
        yaw_rate_max: Largest yaw rate [rad/s].
    """

    command_age_max_ns: int = 250_000_000
    speed_max: float = 6.0
    acceleration_max: float = 12.0
    yaw_rate_max: float = 1.0


class Guard:
    """A state machine on world's clock; starts in GROUND, where no command is flown."""

    def __init__(self, limits: Limits) -> None:
        self._limits = limits
        self.changes: list[GuardChange] = []  # since the last `take_changes`
        self.state = GuardState.GROUND
        self.armed = False  # true from the operator's start of a mission to its end
        self._fresh_until_ns = NEVER_NS
        self._wanted = ZERO
        self.reference: Vector = ZERO
        self.yaw_rate = 0.0  # capped; the published low-level controller holds yaw at 0 regardless
        self._anchor: Vector | None = None

    def put_on_ground(self, now_ns: int, cause: str) -> None:
        """The robot stands at its spawn: rotors off, nothing is remembered."""
        self.armed = False
        self.forget_commands()
        self.reference = ZERO
        self._enter(GuardState.GROUND, now_ns, cause)

    def start_mission(self, now_ns: int) -> None:
        """The operator starts a mission: from here on fresh commands are flown."""
        self.armed = True
        if self.state is not GuardState.GROUND:
            self.forget_commands()  # only what is computed for this mission counts

    def end_mission(self, now_ns: int) -> None:
        """The mission is over: hold here until the operator starts the next one."""
        self.armed = False
        if self.state is TRACK:
            self._enter(GuardState.HOLD, now_ns, "mission ended")

    def forget_commands(self) -> None:
        """A new session begins: what came in the old one is no longer fresh."""
        self._fresh_until_ns = NEVER_NS
        self._wanted = ZERO
        self.yaw_rate = 0.0

    def offer(self, command: Command, now_ns: int) -> str | None:
        """Take a command that the tunnel lets through.

        Args:
            command: Any numbers at all.
            now_ns: World's clock [ns].

        Returns:
            None if it may be flown, else why it is refused: "not_finite" or "stale".
        """
        x, y, z = command.velocity
        if not (isfinite(x) and isfinite(y) and isfinite(z) and isfinite(command.yaw_rate)):
            return "not_finite"
        age_ns = now_ns - command.basis_stamp_ns
        if not 0 <= age_ns <= self._limits.command_age_max_ns:
            return "stale"
        if self.armed:
            self._fresh_until_ns = command.basis_stamp_ns + self._limits.command_age_max_ns
            self._wanted = _shortened(command.velocity, self._limits.speed_max)
            yaw_rate_max = self._limits.yaw_rate_max
            self.yaw_rate = min(max(command.yaw_rate, -yaw_rate_max), yaw_rate_max)
            if self.state is not TRACK:
                self._enter(TRACK, now_ns, "fresh command")
        return None

    def tick(self, now_ns: int, readings: Readings, dt: float) -> Vector:
        """Say what the low-level controller shall follow now; not to be called in GROUND.

        Args:
            now_ns: World's clock [ns].
            readings: Of the sensors on board.
            dt: Time since the last tick [s].

        Returns:
            Velocity reference [m/s], shape (3,).
        """
        if self.state is TRACK:
            if now_ns <= self._fresh_until_ns:
                if self.reference is not self._wanted:
                    step = self._limits.acceleration_max * dt
                    self.reference = _towards(self.reference, self._wanted, step)
                return self.reference
            self._lose_link(now_ns)
        return self._hold(readings.position, readings.velocity, dt)

    def take_changes(self) -> list[GuardChange]:
        """Hand over the changes of state since the last call."""
        changes, self.changes = self.changes, []
        return changes

    def _lose_link(self, now_ns: int) -> None:
        limit_ns = self._limits.command_age_max_ns
        age, limit = (now_ns - self._fresh_until_ns + limit_ns) * 1e-9, limit_ns * 1e-9
        self._enter(GuardState.HOLD, now_ns, f"command age {age:.3f} s above {limit:.3f} s")

    def _hold(self, position: Vector, velocity: Vector, dt: float) -> Vector:
        """Brake until the reference stands still, then hold the position reached by then."""
        if self._anchor is None:
            self.reference = _towards(self.reference, ZERO, BRAKE * dt)
            if self.reference == ZERO and _norm(velocity) < 0.1:
                self._anchor = position
            return self.reference
        pull = _scaled(_minus(self._anchor, position), HOLD_GAIN)
        self.reference = _shortened(pull, HOLD_SPEED_MAX)
        return self.reference

    def _enter(self, state: GuardState, now_ns: int, cause: str) -> None:
        self.state = state
        self._anchor = None
        self.changes.append(GuardChange(now_ns, state, cause))


def _norm(a: Vector) -> float:
    return sqrt(a[0] * a[0] + a[1] * a[1] + a[2] * a[2])


def _minus(a: Vector, b: Vector) -> Vector:
    return (a[0] - b[0], a[1] - b[1], a[2] - b[2])


def _scaled(a: Vector, factor: float) -> Vector:
    return (a[0] * factor, a[1] * factor, a[2] * factor)


def _shortened(a: Vector, length_max: float) -> Vector:
    """`a`, or the vector of its direction that is `length_max` long if `a` is longer."""
    # Scaled down first: the square of a huge but finite number overflows to infinity.
    largest = max(abs(a[0]), abs(a[1]), abs(a[2]))
    if largest > length_max:
        a = _scaled(a, length_max / largest)
        return _scaled(a, min(1.0, length_max / _norm(a)))
    length = _norm(a)
    return a if length <= length_max else _scaled(a, length_max / length)


def _towards(start: Vector, end: Vector, step: float) -> Vector:
    """The point on the way from `start` to `end` that is at most `step` away from `start`."""
    (ax, ay, az), (bx, by, bz) = start, end
    x, y, z = bx - ax, by - ay, bz - az
    length = sqrt(x * x + y * y + z * z)
    if length <= step:
        return end
    share = step / length
    return (ax + share * x, ay + share * y, az + share * z)
