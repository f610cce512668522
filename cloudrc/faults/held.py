"""Questions to the recording of a real flight: how often it held for want of commands, how late."""

from __future__ import annotations

from math import inf

from cloudrc.messages import Cause, GuardState
from cloudrc.record.columns import Recording

AGE_MAX = 0.252 + 1e-9
"""`command_age_max` and one tick, rounding allowed [s]."""


def holds(recording: Recording, since: float = -inf, until: float = inf) -> int:
    """Count the HOLDs for want of fresh commands.

    Args:
        recording: World's.
        since: First instant [s], world's clock.
        until: Last instant [s].
    """
    return sum(since <= stamp_ns * 1e-9 <= until for stamp_ns in _held_ns(recording))


def words(recording: Recording) -> int:
    """Count the HOLDs that teleop has asked for; with each mission's end it asks for one."""
    return sum(
        state == GuardState.HOLD and cause == Cause.ENDED.words
        for _, state, cause in _changes(recording)
    )


def age_at_hold(recording: Recording) -> float:
    """Find the largest age of the newest applied basis at such a HOLD [s]; 0 if there was none."""
    applied, ages = recording["/command_applied"], [0.0]
    for stamp_ns in _held_ns(recording):
        before = applied["basis_stamp_ns"][applied["stamp_ns"] <= stamp_ns]
        if len(before):
            ages.append((stamp_ns - int(before.max())) * 1e-9)
    return max(ages)


def _held_ns(recording: Recording) -> list[int]:
    """When the guard went into them [ns]."""
    changes = _changes(recording)
    return [at_ns for at_ns, state, cause in changes if state == GuardState.HOLD and "age" in cause]


def _changes(recording: Recording) -> list[tuple[int, int, str]]:
    """Instant [ns], state and cause of each change of the guard."""
    guard = recording["/guard"]
    columns = (guard[name].tolist() for name in ("stamp_ns", "state", "cause"))
    return list(zip(*columns, strict=True))
