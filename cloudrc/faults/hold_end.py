"""The invariants of how a HOLD ends: the robot flies on with care, or lands once it was left alone.

TRACK begins a second after the last one at the earliest, a HOLD for silence as long after the last
HOLD, unless commands go back to older odometry, and TRACK out of HOLD on ten fresh commands; then
the robot is led slowly at first. In a mission HOLD ends in LAND after the time that is set for it,
and so does the wait on the ground, ten seconds at least; before that only a cloud that says what is
impossible makes the robot land.

The invariant that the guard rules every step: none of the physics without a tick of its own.

Kept apart from the other invariants, which judge what was flown; this one asks who ruled it.

The invariants of the operator's word: what flies was started, and what has ended is over.

The watch keeps in mind itself whether a mission is on: from the operator's start to its end, to
LAND, ESTOP or the spawn. TRACK is for missions only, and what is latched is left by the operator's
acknowledgement only.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from math import inf, sqrt
from typing import Any, NamedTuple

from cloudrc.messages import ZERO, Cause, Command, GuardState, Vector

GROUND, TRACK, HOLD, LAND, ESTOP = GuardState

TICK_NS = 2_000_000
"""Of the physics [ns]."""


def attach_ticks(robot: Any, start_ns: int, note: Callable[[int, str, str], None]) -> None:
    """Look at every step of a robot that begins now.

    Args:
        robot: Its guard and its simulator are looked at.
        start_ns: Instant of the first step [ns].
        note: Is told of a breach: instant [ns], kind, what happened.
    """
    simulator, guard = robot.simulator, robot.guard
    step, tick = simulator.step, guard.tick
    now_ns, ticked_ns = start_ns, -1

    def watched_tick(when_ns: int, *given: Any) -> Any:
        nonlocal ticked_ns
        ticked_ns = when_ns
        return tick(when_ns, *given)

    def watched_step(rotor_speeds: Any) -> None:
        nonlocal now_ns
        if ticked_ns != now_ns:
            note(now_ns, "tick", "a step of the physics without the guard's tick")
        step(rotor_speeds)
        now_ns += TICK_NS

    simulator.step, guard.tick = watched_step, watched_tick


LATCHED = (LAND, ESTOP)
Note = Callable[[int, str, str], None]
"""Is told of a breach: instant [ns], kind, what happened."""


def attach_word(robot: Any, start_ns: int, note: Note) -> Word:
    """Look at every step of a robot that begins now, and at every word that it hears.

    Args:
        robot: Its guard and its simulator are looked at.
        start_ns: Instant of the first step [ns].
        note: Is told of a breach.
    """
    simulator, guard = robot.simulator, robot.guard
    step, word = simulator.step, Word(guard, note)
    now_ns, was, tracking = start_ns, guard.state, TRACK

    def watched_step(rotor_speeds: Any) -> None:
        nonlocal now_ns, was
        state = guard.state
        if state is not was:
            word.look_at_change(was, state, now_ns)
            was = state
        if state is tracking and not word.armed:
            note(now_ns, "latch", "TRACK without the operator's start")
        step(rotor_speeds)
        now_ns += TICK_NS

    simulator.step = watched_step
    return word


class Word:
    """Hears what the guard is told.

    Attributes:
        armed: Whether a mission is on.
    """

    def __init__(self, guard: Any, note: Note) -> None:
        """Hear everything from now on.

        Args:
            guard: Which.
            note: Is told of a breach.
        """
        self._guard, self._note = guard, note
        self.armed = False
        self._released = set[GuardState]()  # those acknowledged; before a step they may be several
        self._start, self._end, self._stop = guard.start_mission, guard.end_mission, guard.stop
        self._acknowledge, self._put_on_ground = guard.acknowledge, guard.put_on_ground
        guard.start_mission, guard.end_mission = self.start_mission, self.end_mission
        guard.stop, guard.acknowledge = self.stop, self.acknowledge
        guard.put_on_ground = self.put_on_ground

    def start_mission(self, when_ns: int) -> None:
        """The operator starts a mission."""
        self.armed = self.armed or self._guard.state not in LATCHED
        self._start(when_ns)

    def end_mission(self, when_ns: int) -> None:
        """The operator ends it."""
        self.armed = False
        self._end(when_ns)

    def stop(self, when_ns: int) -> None:
        """The operator stops the rotors."""
        self.armed = False
        self._stop(when_ns)

    def acknowledge(self, when_ns: int) -> None:
        """The operator has seen it land, or stopped."""
        self._released.add(self._guard.state)
        self._acknowledge(when_ns)

    def put_on_ground(self, when_ns: int, cause: str) -> None:
        """The operator has it stand at its spawn."""
        self.armed = False
        self._put_on_ground(when_ns, cause)

    def look_at_change(self, was: GuardState, state: GuardState, now_ns: int) -> None:
        """What has landed or was stopped stays so until the operator has seen it."""
        released = self._released
        if was in LATCHED and released.isdisjoint(LATCHED) and state is not ESTOP:
            self._note(now_ns, "latch", f"{was.name} left for {state.name} without the operator")
        released.intersection_update({state})
        self.armed = self.armed and state not in LATCHED


RESUME_COMMANDS = 10
RESUME_NS = 500_000_000
"""RESUME_COMMANDS fresh commands within this time end a HOLD [ns].
Source: docs/reference/plant.md, "Leaving HOLD"."""
SETTLE_NS = 1_000_000_000
"""Least time from one TRACK to the next, and from one HOLD to the next [ns].
Source: docs/reference/faults.md, "F5"."""
INVALID_COMMANDS = 5
INVALID_NS = 1_000_000_000
"""INVALID_COMMANDS impossible commands within this time make the robot land [ns].
Source: docs/reference/faults.md, "F23"."""
INVALID = ("range", "future")
"""Why the guard refuses those."""
GROUND_NS = 10_000_000_000
"""Least time for which a robot on the ground waits for a mission's first command [ns].
Source: docs/safety.md, "The guard"."""
RAMP = 3.0
"""Largest growth of the reference after a HOLD [m/s^2].
Source: docs/reference/plant.md, "Leaving HOLD"."""
RAMP_MIN = 1.0
"""The reference grows slowly for at least this time, and until it may reach the cap [s].
Source: docs/safety.md, "The guard"."""
SLACK = 1e-9
"""For rounding [m/s]."""


class Patience(NamedTuple):
    """What is set for the guard, learned from the configuration and not from it.

    Attributes:
        speed_max: Cap on the reference [m/s].
        hold_max_ns: HOLD in a mission ends in LAND after it [ns].
    """

    speed_max: float
    hold_max_ns: int


def attach_hold_end(robot: Any, start_ns: int, note: Note, word: Word, patience: Patience) -> None:
    """Look at every step of a robot that begins now, and at every command that it takes.

    Args:
        robot: Its guard and its simulator are looked at.
        start_ns: Instant of the first step [ns].
        note: Is told of a breach.
        word: Knows whether a mission is on; its robot is the same.
        patience: How long the robot waits.
    """
    simulator, guard = robot.simulator, robot.guard
    step, end = simulator.step, HoldEnd(guard, note, word, patience)
    now_ns, was, before, track = start_ns, guard.state, ZERO, TRACK

    def watched_step(rotor_speeds: Any) -> None:
        nonlocal now_ns, was, before
        state, reference = guard.state, guard.reference
        if state is not was:
            end.look_at_change(was, state, now_ns)
            was = state
        if state is not track:
            end.look_at_wait(state, now_ns)
        elif reference is not before and now_ns < end.ramp_until_ns:
            end.look_at_ramp(before, reference, now_ns)
        before = reference
        step(rotor_speeds)
        now_ns += TICK_NS

    simulator.step = watched_step


class HoldEnd:
    """Keeps in mind since when a robot has been left alone, and what it has heard meanwhile.

    Attributes:
        ramp_until_ns: Until then it is led slowly [ns].
    """

    def __init__(self, guard: Any, note: Note, word: Word, patience: Patience) -> None:
        """Hear every command from now on, and what lets earlier ones be forgotten.

        Args:
            guard: Which.
            note: Is told of a breach.
            word: Knows whether a mission is on.
            patience: How long the robot waits.
        """
        self._guard, self._note, self._word = guard, note, word
        self._ramp_ns = round(max(RAMP_MIN, patience.speed_max / RAMP) * 1e9)
        self._alone_max_ns = patience.hold_max_ns
        self.ramp_until_ns = -1
        self._alone_ns = 0
        self._tracked_ns = self._held_ns = -SETTLE_NS
        self._stood = self._impossible = self._goes_back = False
        self._basis_ns = -1
        self._fresh_ns: deque[int] = deque(maxlen=RESUME_COMMANDS)
        self._invalid_ns: deque[int] = deque(maxlen=INVALID_COMMANDS)
        self._offer, self._forget = guard.offer, guard.forget_commands
        self._start, self._put_on_ground = guard.start_mission, guard.put_on_ground
        guard.offer, guard.forget_commands = self.offer, self.forget_commands
        guard.start_mission, guard.put_on_ground = self.start_mission, self.put_on_ground

    def offer(self, command: Command, when_ns: int) -> Any:
        """Count the fresh commands in a HOLD, and the impossible ones."""
        state = self._guard.state
        refusal = self._offer(command, when_ns)
        if refusal in INVALID:
            self._invalid_ns.append(when_ns)
            took_ns = when_ns - self._invalid_ns[0]
            if len(self._invalid_ns) == INVALID_COMMANDS and took_ns <= INVALID_NS:
                self._impossible = True
        elif not refusal and self._word.armed:
            self._goes_back = command.basis_stamp_ns < self._basis_ns
            self._basis_ns = max(self._basis_ns, command.basis_stamp_ns)
            if state is HOLD:
                self._fresh_ns.append(when_ns)
            elif state is GROUND:
                self._alone_ns = when_ns
        return refusal

    def forget_commands(self) -> None:
        """What came before is no longer fresh."""
        self._fresh_ns.clear()
        self._invalid_ns.clear()
        self._forget()

    def start_mission(self, when_ns: int) -> None:
        """The operator starts a mission: from now on the robot waits for its cloud."""
        if not self._word.armed:
            self._fresh_ns.clear()
            self._alone_ns = when_ns
        self._start(when_ns)

    def put_on_ground(self, when_ns: int, cause: str) -> None:
        """The operator has it stand at its spawn: what was, counts no more."""
        self._tracked_ns = self._held_ns = -SETTLE_NS
        self._stood, self.ramp_until_ns = True, -1
        self._put_on_ground(when_ns, cause)

    def look_at_change(self, was: GuardState, state: GuardState, now_ns: int) -> None:
        """The robot flies on once the link has proven itself, and lands when it was left alone."""
        self.ramp_until_ns = -1
        if state is TRACK:
            self._look_at_track(was, now_ns)
        elif state is HOLD or (was is TRACK and state is GROUND and not self._stood):
            self._look_at_hold(state, now_ns)  # one that had not left the ground yet, perhaps
        elif state is LAND and not self._impossible:
            alone_ns = now_ns - self._alone_ns
            if was is TRACK or alone_ns <= self._wait_ns(was):
                text = f"LAND out of {was.name} after {alone_ns * 1e-9:.3f} s alone"
                self._note(now_ns, "hold", text)
        if state is not HOLD:
            self._fresh_ns.clear()
        self._stood = self._impossible = False

    def _look_at_track(self, was: GuardState, now_ns: int) -> None:
        fresh_ns, settled_ns = self._fresh_ns, now_ns - self._tracked_ns
        self._tracked_ns = now_ns
        if settled_ns < SETTLE_NS:
            self._note(now_ns, "hold", f"TRACK again after {settled_ns * 1e-9:.3f} s")
        if was is HOLD and not self._stood:
            self.ramp_until_ns = now_ns + self._ramp_ns
            took_ns = now_ns - fresh_ns[0] if fresh_ns else 0
            if len(fresh_ns) < RESUME_COMMANDS or fresh_ns[-1] - fresh_ns[0] > RESUME_NS:
                text = f"{len(fresh_ns)} fresh commands within {took_ns * 1e-9:.3f} s"
                self._note(now_ns, "stale", f"HOLD left for TRACK on {text}")

    def _look_at_hold(self, state: GuardState, now_ns: int) -> None:
        settled_ns = now_ns - self._held_ns
        self._held_ns = self._alone_ns = now_ns
        silent = state is HOLD and self._guard.cause is Cause.SILENCE and not self._goes_back
        if silent and settled_ns < SETTLE_NS:
            self._note(now_ns, "hold", f"HOLD again after {settled_ns * 1e-9:.3f} s")

    def _wait_ns(self, state: GuardState) -> float:
        """How long a robot in a mission waits for its cloud [ns]."""
        if state is GROUND:
            return max(self._alone_max_ns, GROUND_NS)
        return self._alone_max_ns if state is HOLD else inf

    def look_at_wait(self, state: GuardState, now_ns: int) -> None:
        """In a mission nobody waits for a cloud for ever."""
        self._impossible = False
        alone_ns = now_ns - self._alone_ns
        if self._word.armed and alone_ns > self._wait_ns(state) + TICK_NS:
            self._note(now_ns, "hold", f"{state.name} for {alone_ns * 1e-9:.3f} s of a mission")
            self._alone_ns = now_ns

    def look_at_ramp(self, before: Vector, reference: Vector, now_ns: int) -> None:
        """Out of HOLD the robot is led slowly.

        Args:
            before: Reference a tick ago [m/s], shape (3,).
            reference: Now [m/s], shape (3,).
            now_ns: World's clock [ns].
        """
        grown = growth(before, reference)
        if not grown <= RAMP * TICK_NS * 1e-9 + SLACK:
            self._note(now_ns, "cap", f"reference grows by {grown:.9f} m/s in a tick after a HOLD")


def growth(before: Vector, after: Vector) -> float:
    """By how much a reference leads further away from rest than before [m/s].

    Args:
        before: A tick ago [m/s], shape (3,).
        after: Now [m/s], shape (3,).
    """
    (ux, uy, uz), (vx, vy, vz) = before, after
    return sqrt(_grown(ux, vx) ** 2 + _grown(uy, vy) ** 2 + _grown(uz, vz) ** 2)


def _grown(before: float, after: float) -> float:
    if before * after < 0.0:
        return abs(after)
    return max(abs(after) - abs(before), 0.0)
