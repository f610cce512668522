"""The invariant of how rotors stop: by a word, by a hit, or where the robot stands.

A guard that lets its rotors stop in the air drops the robot. Told by what the simulator is given,
not by speeds of 0, which hard braking commands, too.
"""

from __future__ import annotations

from collections.abc import Callable
from math import inf
from typing import Any

from cloudrc.faults.ticks import TICK_NS
from cloudrc.messages import GuardState, Vector
from cloudrc.world.rotors import STOPPED

ESTOP = GuardState.ESTOP
STANDS = 0.2
"""What stands has no component of its velocity above this [m/s]."""
FALL = 1.0
"""Faster down than what drops from no higher than the guard's 0.02 m [m/s]: that gets to 0.7."""
REELS_NS = 1_000_000_000
"""For so long a hit explains what has become of the robot [ns]."""


def attach(
    robot: Any, start_ns: int, note: Callable[[int, str, str], None], *, honest: bool
) -> None:
    """Look at every step of a robot that begins now.

    Args:
        robot: Its guard and its simulator are looked at.
        start_ns: Instant of the first step [ns].
        note: Is told of a breach: instant [ns], kind, what happened.
        honest: Whether a hit that was none is a breach.
    """
    simulator, guard = robot.simulator, robot.guard
    step, stop, put_on_ground = simulator.step, guard.stop, guard.put_on_ground
    now_ns, was, turned, asked = start_ns, guard.state, False, False
    halted, stopped, standing, falling = False, ESTOP, STOPPED, -FALL

    def watched_stop(when_ns: int) -> None:
        nonlocal asked
        asked = True
        stop(when_ns)

    def watched_put_on_ground(when_ns: int, cause: str) -> None:
        nonlocal asked
        asked = True
        put_on_ground(when_ns, cause)

    def watched_step(rotor_speeds: Any) -> None:
        nonlocal now_ns, was, turned, asked, halted
        state, turns = guard.state, rotor_speeds is not standing
        if state is not was:
            if state is stopped and honest and not asked and not has_touched(simulator):
                note(now_ns, "collision", "stopped by a hit although nothing was touched")
            was = state
        if turned and not turns:
            halted = not asked and state is not stopped
            if halted:
                _look_at_halt(simulator.readings.velocity, state, now_ns, note)
        elif halted:
            halted = not turns and not asked
            if halted and simulator.readings.velocity[2] < falling and not has_touched(simulator):
                note(now_ns, "rest", f"falls in {state.name}, its rotors stopped in the air")
                halted = False
        turned, asked = turns, False
        step(rotor_speeds)
        now_ns += TICK_NS

    simulator.step, guard.stop = watched_step, watched_stop
    guard.put_on_ground = watched_put_on_ground


def has_touched(simulator: Any) -> bool:
    """Say whether the robot touches something, or has just touched it."""
    last = max(simulator._last_touch.values(), default=-inf)
    return bool((simulator._steps - last) * TICK_NS <= REELS_NS)


def _look_at_halt(
    velocity: Vector, state: GuardState, now_ns: int, note: Callable[[int, str, str], None]
) -> None:
    fastest = max(map(abs, velocity))
    if not fastest <= STANDS:
        note(now_ns, "rest", f"rotors stopped in {state.name} at {fastest:.2f} m/s")
