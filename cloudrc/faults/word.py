"""The invariants of the operator's word: what flies was started, and what has ended is over.

The watch keeps in mind itself whether a mission is on: from the operator's start to its end, to
LAND, ESTOP or the spawn. TRACK is for missions only, and what is latched is left by the operator's
acknowledgement only.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from cloudrc.faults.ticks import TICK_NS
from cloudrc.messages import GuardState

_, TRACK, _, LAND, ESTOP = GuardState
LATCHED = (LAND, ESTOP)
Note = Callable[[int, str, str], None]
"""Is told of a breach: instant [ns], kind, what happened."""


def attach(robot: Any, start_ns: int, note: Note) -> Word:
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
