"""The invariants of the operator's word: what flies was started, and what has ended is over.

The watch keeps in mind itself whether a mission is on: from the operator's start to its end, to
LAND, ESTOP or the spawn. TRACK is for missions only, what is latched is left by the operator's
acknowledgement only, and a HOLD for TRACK once the link has proven itself.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from typing import Any

from cloudrc.faults.ticks import TICK_NS
from cloudrc.messages import Command, GuardState

GROUND, TRACK, HOLD, LAND, ESTOP = GuardState
LATCHED = (LAND, ESTOP)
RESUME_COMMANDS = 10
RESUME_NS = 500_000_000
"""So many fresh commands within so long end a HOLD [ns]. Source: DESIGN, section 5."""

Note = Callable[[int, str, str], None]
"""Is told of a breach: instant [ns], kind, what happened."""


def attach(robot: Any, start_ns: int, note: Note) -> None:
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
        self.armed = self._stood = False
        self._released = set[GuardState]()  # those acknowledged; before a step they may be several
        self._fresh_ns: deque[int] = deque(maxlen=RESUME_COMMANDS)
        self._offer, self._forget = guard.offer, guard.forget_commands
        self._start, self._end, self._stop = guard.start_mission, guard.end_mission, guard.stop
        self._acknowledge, self._put_on_ground = guard.acknowledge, guard.put_on_ground
        guard.offer, guard.forget_commands = self.offer, self.forget_commands
        guard.start_mission, guard.end_mission = self.start_mission, self.end_mission
        guard.stop, guard.acknowledge = self.stop, self.acknowledge
        guard.put_on_ground = self.put_on_ground

    def offer(self, command: Command, when_ns: int) -> Any:
        """Count the fresh commands in a HOLD."""
        holds = self._guard.state is HOLD
        refusal = self._offer(command, when_ns)
        if holds and self.armed and not refusal:
            self._fresh_ns.append(when_ns)
        return refusal

    def forget_commands(self) -> None:
        """What came before is no longer fresh."""
        self._fresh_ns.clear()
        self._forget()

    def start_mission(self, when_ns: int) -> None:
        """The operator starts a mission."""
        if self._guard.state not in LATCHED:
            if not self.armed:
                self._fresh_ns.clear()
            self.armed = True
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
        self.armed, self._stood = False, True
        self._put_on_ground(when_ns, cause)

    def look_at_change(self, was: GuardState, state: GuardState, now_ns: int) -> None:
        """What has landed or was stopped stays so; what holds flies on by more than one command."""
        released, stood = self._released, self._stood
        if was in LATCHED and released.isdisjoint(LATCHED) and state is not ESTOP:
            self._note(now_ns, "latch", f"{was.name} left for {state.name} without the operator")
        released.intersection_update({state})
        self._stood = False
        if state in LATCHED:
            self.armed = False
        elif state is TRACK:
            if was is HOLD and not stood:
                self._look_at_resume(now_ns)
            self._fresh_ns.clear()

    def _look_at_resume(self, now_ns: int) -> None:
        fresh_ns = self._fresh_ns
        took_ns = now_ns - fresh_ns[0] if fresh_ns else 0
        if len(fresh_ns) < RESUME_COMMANDS or fresh_ns[-1] - fresh_ns[0] > RESUME_NS:
            text = f"{len(fresh_ns)} fresh commands within {took_ns * 1e-9:.3f} s"
            self._note(now_ns, "stale", f"HOLD left for TRACK on {text}")
