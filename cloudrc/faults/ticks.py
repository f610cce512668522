"""The invariant that the guard rules every step: none of the physics without a tick of its own.

Kept apart from the other invariants, which judge what was flown; this one asks who ruled it.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

TICK_NS = 2_000_000
"""Of the physics [ns]."""


def attach(robot: Any, start_ns: int, note: Callable[[int, str, str], None]) -> None:
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
