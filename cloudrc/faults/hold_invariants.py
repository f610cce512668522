"""Invariants of the operator's requests and of the end of a HOLD.

latch  TRACK is for missions that the operator has started. What has landed or was stopped stays so
       until the operator acknowledges it.
hold   TRACK begins at least `SETTLE_NS` after the last TRACK, and a HOLD for silence as long after
       the last HOLD, unless commands go back to older odometry. In a mission a robot without
       commands lands after the configured time, and not before, unless its cloud sends impossible
       commands.
stale  HOLD becomes TRACK on `RESUME_COMMANDS` fresh commands within `RESUME_NS`.
cap    After a HOLD the reference grows slowly at first.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from math import inf, sqrt

from cloudrc.messages import (
    ZERO,
    Cause,
    Command,
    GuardState,
    OperatorRequest,
    Request,
    Start,
    Vector,
)
from cloudrc.world.robot import STEP_NS

GROUND, TRACK, HOLD, LAND, ESTOP = GuardState
LATCHED = (LAND, ESTOP)
RESUME_COMMANDS = 10
RESUME_NS = 500_000_000
"""Time within which RESUME_COMMANDS fresh commands end a HOLD [ns].
Source: docs/reference/plant.md, "Leaving HOLD"."""
SETTLE_NS = 1_000_000_000
"""Shortest time from one TRACK to the next, and from one HOLD to the next [ns].
Source: docs/reference/faults.md, "F5"."""
INVALID_COMMANDS = 5
INVALID_NS = 1_000_000_000
"""Time within which INVALID_COMMANDS impossible commands make the robot land [ns].
Source: docs/reference/faults.md, "F23"."""
INVALID = ("range", "future")
"""Reasons for which the guard rejects impossible commands."""
GROUND_NS = 10_000_000_000
"""Shortest time for which a robot on the ground waits for a mission's first command [ns].
Source: docs/safety.md, "The guard"."""
RAMP = 3.0
"""Largest growth of the reference after a HOLD [m/s^2].
Source: docs/reference/plant.md, "Leaving HOLD"."""
RAMP_MIN = 1.0
"""Shortest time for which the reference grows slowly [s]; it is longer if the cap is higher.
Source: docs/safety.md, "The guard"."""
SLACK = 1e-9
"""Tolerance for rounding [m/s]."""
Note = Callable[[int, str, str], None]
"""Takes a breach: time [ns, world's clock], kind, text."""


class OperatorInvariants:
    """Tracks what the operator has asked for.

    Attributes:
        armed: Whether a mission is on.
    """

    def __init__(self, note: Note) -> None:
        self._note = note
        self.armed = False
        self._released = set[GuardState]()  # states acknowledged since the last change

    def see_request(self, request: OperatorRequest, state: GuardState) -> None:
        """Note a request that was carried out in a state of the guard."""
        if request.request is Request.START:
            self.armed = True
        elif request.request in (Request.END, Request.ESTOP):
            self.armed = False
        elif request.request is Request.ACKNOWLEDGE:
            self._released.add(state)

    def see_change(self, was: GuardState, state: GuardState, now_ns: int) -> None:
        """Check that a latched state ends by an acknowledgement only."""
        released = self._released
        if was in LATCHED and released.isdisjoint(LATCHED) and state is not ESTOP:
            self._note(now_ns, "latch", f"{was.name} left for {state.name} without the operator")
        released.intersection_update({state})
        self.armed = self.armed and state not in LATCHED


class HoldInvariants:
    """Checks how long a robot waits without commands, and what lets it fly again."""

    def __init__(
        self, note: Note, operator: OperatorInvariants, speed_max: float, hold_max_ns: int
    ) -> None:
        """Start on the ground.

        Args:
            note: Takes a breach.
            operator: Knows whether a mission is on.
            speed_max: Largest reference [m/s].
            hold_max_ns: Time in a mission after which HOLD becomes LAND [ns].
        """
        self._note, self._operator = note, operator
        self._ramp_ns = round(max(RAMP_MIN, speed_max / RAMP) * 1e9)
        self._alone_max_ns = hold_max_ns
        self._ramp_until_ns = -1
        self._alone_ns = 0
        self._tracked_ns = self._held_ns = -SETTLE_NS
        self._is_reset = self._impossible = self._goes_back = False
        self._basis_ns, self._before = -1, ZERO
        self._fresh_ns: deque[int] = deque(maxlen=RESUME_COMMANDS)
        self._invalid_ns: deque[int] = deque(maxlen=INVALID_COMMANDS)

    def see_command(
        self, command: Command, rejection: str | None, state: GuardState, now_ns: int
    ) -> None:
        """Count the fresh commands in a HOLD, and the impossible ones."""
        if rejection in INVALID:
            self._invalid_ns.append(now_ns)
            took_ns = now_ns - self._invalid_ns[0]
            if len(self._invalid_ns) == INVALID_COMMANDS and took_ns <= INVALID_NS:
                self._impossible = True
        elif rejection is None and self._operator.armed:
            self._goes_back = command.basis_stamp_ns < self._basis_ns
            self._basis_ns = max(self._basis_ns, command.basis_stamp_ns)
            if state is HOLD:
                self._fresh_ns.append(now_ns)
            elif state is GROUND:
                self._alone_ns = now_ns

    def forget_commands(self) -> None:
        """Forget earlier commands: a new session begins."""
        self._fresh_ns.clear()
        self._invalid_ns.clear()

    def see_request(self, request: OperatorRequest, now_ns: int) -> None:
        """Note a start, before `operator` does; from now on the robot waits for its cloud."""
        if request.request is not Request.START:
            return
        if request.start is Start.SPAWN:
            self._tracked_ns = self._held_ns = -SETTLE_NS
            self._is_reset, self._ramp_until_ns = True, -1
        if request.start is Start.SPAWN or not self._operator.armed:
            self.forget_commands()
            self._alone_ns = now_ns

    def see_change(self, was: GuardState, state: GuardState, cause: Cause, now_ns: int) -> None:
        """Check a change of the guard's state."""
        self._ramp_until_ns = -1
        if state is TRACK:
            self._check_track(was, now_ns)
        elif state is HOLD or (was is TRACK and state is GROUND and not self._is_reset):
            self._check_hold(state, cause, now_ns)  # perhaps it has not left the ground yet
        elif state is LAND and not self._impossible:
            alone_ns = now_ns - self._alone_ns
            if was is TRACK or alone_ns <= self._wait_ns(was):
                text = f"LAND out of {was.name} after {alone_ns * 1e-9:.3f} s alone"
                self._note(now_ns, "hold", text)
        if state is not HOLD:
            self._fresh_ns.clear()
        self._is_reset = self._impossible = False

    def see_step(self, state: GuardState, reference: Vector, now_ns: int) -> None:
        """Check the wait for the cloud, or the growth of `reference` [m/s] after a HOLD."""
        if state is not TRACK:
            self._impossible = False
            alone_ns = now_ns - self._alone_ns
            if self._operator.armed and alone_ns > self._wait_ns(state) + STEP_NS:
                self._note(now_ns, "hold", f"{state.name} for {alone_ns * 1e-9:.3f} s of a mission")
                self._alone_ns = now_ns
        elif reference is not self._before and now_ns < self._ramp_until_ns:
            grown = growth(self._before, reference)
            if not grown <= RAMP * STEP_NS * 1e-9 + SLACK:
                text = f"reference grows by {grown:.9f} m/s in a tick after a HOLD"
                self._note(now_ns, "cap", text)
        self._before = reference

    def _check_track(self, was: GuardState, now_ns: int) -> None:
        fresh_ns, settled_ns = self._fresh_ns, now_ns - self._tracked_ns
        self._tracked_ns = now_ns
        if settled_ns < SETTLE_NS:
            self._note(now_ns, "hold", f"TRACK again after {settled_ns * 1e-9:.3f} s")
        if was is HOLD and not self._is_reset:
            self._ramp_until_ns = now_ns + self._ramp_ns
            took_ns = now_ns - fresh_ns[0] if fresh_ns else 0
            if len(fresh_ns) < RESUME_COMMANDS or fresh_ns[-1] - fresh_ns[0] > RESUME_NS:
                text = f"{len(fresh_ns)} fresh commands within {took_ns * 1e-9:.3f} s"
                self._note(now_ns, "stale", f"HOLD left for TRACK on {text}")

    def _check_hold(self, state: GuardState, cause: Cause, now_ns: int) -> None:
        settled_ns = now_ns - self._held_ns
        self._held_ns = self._alone_ns = now_ns
        silent = state is HOLD and cause is Cause.SILENCE and not self._goes_back
        if silent and settled_ns < SETTLE_NS:
            self._note(now_ns, "hold", f"HOLD again after {settled_ns * 1e-9:.3f} s")

    def _wait_ns(self, state: GuardState) -> float:
        """Return how long a robot in a mission waits for its cloud [ns]."""
        if state is GROUND:
            return max(self._alone_max_ns, GROUND_NS)
        return self._alone_max_ns if state is HOLD else inf


def growth(before: Vector, after: Vector) -> float:
    """Return how much further from rest a reference is than before [m/s].

    Args:
        before: Reference a tick ago [m/s], shape (3,).
        after: Reference now [m/s], shape (3,).
    """
    (ux, uy, uz), (vx, vy, vz) = before, after
    return sqrt(_grown(ux, vx) ** 2 + _grown(uy, vy) ** 2 + _grown(uz, vz) ** 2)


def _grown(before: float, after: float) -> float:
    if before * after < 0.0:
        return abs(after)
    return max(abs(after) - abs(before), 0.0)
