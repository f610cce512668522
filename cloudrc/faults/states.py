"""Which state the guard was in: now, at an instant, and when something was touched."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from cloudrc.messages import Cause, GuardState
from cloudrc.records import GuardChange

GROUND, _, HOLD, LAND, ESTOP = GuardState
PERIOD_NS = 10_000_000
"""Of odometry, by which a contact is told [ns]: it began within so long before its stamp."""
BRAKES_NS = 200_000_000
"""Time within which a descent that the operator has acknowledged is stopped [ns].
Source: docs/reference/plant.md, "Stop rule"."""


def seen_now(world: Any) -> tuple[GuardState, str]:
    """Tell the state of the guard that lives, and why; a world that is down has none: GROUND.

    A new world notes no change before its first: what changed last may have been another's.

    Args:
        world: That end, or None.
    """
    if world is None:
        return GROUND, "the world is down"
    guard = world.robot.guard
    return guard.state, guard.cause.words


def state_at(changes: Sequence[GuardChange], stamp_ns: int, born_ns: int) -> GuardState:
    """Tell the guard's state at an instant.

    Args:
        changes: Of the guards of all worlds so far, in order.
        stamp_ns: When [ns, world's clock].
        born_ns: When the newest world began [ns].
    """
    change = _last(changes, stamp_ns, born_ns)
    return GROUND if change is None else change.state


def state_before(changes: Sequence[GuardChange], stamp_ns: int, born_ns: int) -> GuardState:
    """Tell the guard's state when a contact began, which may have stopped the rotors since.

    Args:
        changes: Of the guards of all worlds so far, in order.
        stamp_ns: Of the contact [ns, world's clock].
        born_ns: When the newest world began [ns].
    """
    change = _last(changes, stamp_ns, born_ns)
    if change is None:
        return GROUND
    state = change.state
    if state is ESTOP and change.cause != Cause.STOPPED.words:
        began_ns = stamp_ns - PERIOD_NS
        if change.stamp_ns > began_ns:  # it is what the contact did
            state = state_at(changes, change.stamp_ns - 1, born_ns)
    if state is HOLD and state_at(changes, stamp_ns - BRAKES_NS, born_ns) is LAND:
        state = LAND  # acknowledged right above a pipe that it was about to land on
    return state


def _last(changes: Sequence[GuardChange], stamp_ns: int, born_ns: int) -> GuardChange | None:
    """Find the last change up to an instant, in the world that lived then."""
    for change in reversed(changes):
        if change.stamp_ns <= stamp_ns:
            return None if change.stamp_ns < born_ns <= stamp_ns else change
    return None
