"""What the invariants know of a robot, its scene and its limits."""

from __future__ import annotations

from collections.abc import Callable
from math import inf
from typing import NamedTuple, TypeAlias

from cloudrc.config.load import ResolvedGuard
from cloudrc.messages import GuardState, Vector

GROUND, TRACK, HOLD, LAND, ESTOP = GuardState
FLOWN, LATCHED = (TRACK, HOLD, LAND), (LAND, ESTOP)
"""States in which the actuators are on; states that the operator's acknowledgement ends."""
REELS_NS = 1_000_000_000  # time after a collision in which it explains the robot's motion [ns]
Note: TypeAlias = Callable[[int, str, str], None]
"""Function that records a breach: time on world's clock [ns], name of the invariant, text."""


class Facts(NamedTuple):
    """Limits of the guard, and what the robot can do."""

    limits: ResolvedGuard
    low: Vector  # corner of the fence [m]; a planar robot has no floor and no ceiling
    high: Vector  # opposite corner [m]
    braking: float  # deceleration of the robot [m/s^2]
    planar: bool  # whether the robot stays on the ground

    @classmethod
    def of(
        cls, limits: ResolvedGuard, low: Vector, high: Vector, braking: float, *, planar: bool
    ) -> Facts:
        """Make the facts; for a `planar` robot, leave out floor and ceiling of the fence.

        `low` and `high` are corners of the scene's fence [m], world frame. `braking` is the
        deceleration of the robot [m/s^2].
        """
        if planar:
            low, high = (*low[:2], -inf), (*high[:2], inf)
        return cls(limits, low, high, braking, planar)
