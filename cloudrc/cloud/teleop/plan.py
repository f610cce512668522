"""The plan of a mission: a person's or an experiment's waypoints come in, checked legs go out."""

from __future__ import annotations

from dataclasses import dataclass
from math import isfinite, isnan

from cloudrc.errors import BadInputError
from cloudrc.messages import ZERO, Start, Vector


@dataclass(frozen=True, slots=True)
class Leg:
    """The way to one waypoint, which is reached by staying near it.

    Attributes:
        position: Waypoint [m], world frame, shape (3,).
        yaw: Heading to hold [rad].
        tolerance: Distance that counts as there [m]. Infinite: anywhere counts, and the leg lasts
            `dwell`; that is how steps at fixed instants are flown.
        dwell: How long to be seen within the tolerance without a break [s].
        time_limit: Longest duration of the leg, held time not counted [s].
    """

    position: Vector
    yaw: float = 0.0
    tolerance: float = 0.10
    dwell: float = 0.5
    time_limit: float = 60.0

    def __post_init__(self) -> None:
        """Check the values.

        Raises:
            BadInputError: If one is not a number or out of range.
        """
        if not all(map(isfinite, (*self.position, self.yaw))):
            raise BadInputError(f"waypoint {self.position}, yaw {self.yaw}: has to be finite")
        if isnan(self.tolerance) or self.tolerance <= 0:
            raise BadInputError(f"waypoint tolerance {self.tolerance} m: has to be above 0")
        if not (isfinite(self.dwell) and self.dwell >= 0):
            raise BadInputError(f"waypoint dwell {self.dwell} s: has to be finite and >= 0")
        if not (isfinite(self.time_limit) and self.time_limit > 0):
            raise BadInputError(f"time limit {self.time_limit} s: has to be finite and above 0")


@dataclass(frozen=True, slots=True)
class Plan:
    """A mission.

    Attributes:
        legs: What to fly, in order; at least one.
        start: From the spawn, in a fresh world, or from here.
        time_limit: Longest duration of the mission, held time counted [s].
    """

    legs: tuple[Leg, ...]
    start: Start = Start.SPAWN
    time_limit: float = 60.0

    def __post_init__(self) -> None:
        """Check the values.

        Raises:
            BadInputError: If there is no leg or the limit is out of range.
        """
        if not self.legs:
            raise BadInputError("a mission needs at least one waypoint")
        if not (isfinite(self.time_limit) and self.time_limit > 0):
            raise BadInputError(f"time limit {self.time_limit} s: has to be finite and above 0")


NO_PLAN = Plan((Leg(ZERO),))
"""Stands in until the first mission starts; never flown."""
