"""What the guard allows: set on world's side only, checked once, never zero and never infinite.

A limit that is switched off is the fault that nobody sees, so there is no value that does it.
"""

from __future__ import annotations

from dataclasses import dataclass
from math import isfinite

from cloudrc.geometry.fence import FLOOR_MARGIN
from cloudrc.messages import Vector
from cloudrc.world.guard_rules import BRAKE, MARGIN, REACTION, STOPPING_DISTANCE, stopping_distance

AGE_MAX_NS = 10_000_000_000
"""Commands that are older are never flown [ns], whatever an experiment says."""
GROUND_MIN_NS = 10_000_000_000
"""A robot on the ground waits for a mission's first command for so long at least [ns]: it comes a
round trip behind the start, 0.6 s by `satellite`, or some, if one end has not heard the other."""
RAMP_MIN = 1.0
"""Out of HOLD the reference is led slowly for so long at least [s]."""
RANGE = 1000.0
"""Largest number of a command that is shortened to a cap, not refused [m/s, rad/s]: no controller
asks a robot for more. One that does has a bug, and its direction is as wrong as its length.
Source: docs/reference/faults.md, "F23"."""


@dataclass(frozen=True, slots=True)
class Limits:
    """What the guard allows.

    Attributes:
        fence_low: Corner of the box that the base may not leave [m], world frame, shape (3,).
        fence_high: The opposite corner [m], shape (3,).
        command_age_max_ns: Age of the basis beyond which a command is not flown [ns].
        speed_max: Largest speed [m/s].
        acceleration_max: Largest change of the reference [m/s^2].
        yaw_rate_max: Largest yaw rate [rad/s].
        hold_max_ns: HOLD for so long in a mission ends in LAND [ns]; see `alone_max_ns`.
    """

    fence_low: Vector
    fence_high: Vector
    command_age_max_ns: int = 250_000_000
    speed_max: float = 6.0
    acceleration_max: float = 12.0
    yaw_rate_max: float = 1.0
    hold_max_ns: int = 60_000_000_000

    def __post_init__(self) -> None:
        """Refuse what would switch a limit off.

        Raises:
            ValueError: If a limit is not finite, not above 0 or, for the speed and the age, beyond
                what can be stopped in time; the message names it.
        """
        for name in self.__slots__[2:]:
            value = getattr(self, name)
            if not (isfinite(value) and value > 0):
                raise ValueError(f"guard: {name} is {value}; it has to be finite and above 0")
        if self.command_age_max_ns > AGE_MAX_NS:
            raise ValueError(f"guard: command_age_max_ns is {self.command_age_max_ns}, above 10 s")
        way = stopping_distance(self.speed_max, self.command_age_max_ns * 1e-9 + REACTION)
        if way > STOPPING_DISTANCE + 1e-4:
            raise ValueError(
                f"guard: speed_max is {self.speed_max:g} m/s, from which stopping takes {way:.2f} m"
                f" with commands that old; at most {STOPPING_DISTANCE:g} m are allowed"
            )
        for low, high in zip(self.fence_low, self.fence_high, strict=True):
            if not (isfinite(low) and isfinite(high) and high - low > FLOOR_MARGIN + MARGIN):
                raise ValueError(f"guard: a fence from {low:g} to {high:g} m leaves no room")

    @property
    def ramp_ns(self) -> int:
        """How long the reference grows by no more than BRAKE after a HOLD [ns]: to the cap.

        By time alone: the first commands after a silence rest, and a ramp that ended where the
        reference has caught up with them would be none.
        Source: docs/reference/plant.md, "Leaving HOLD".
        """
        return round(max(RAMP_MIN, self.speed_max / BRAKE) * 1e9)

    def alone_max_ns(self, flies: bool) -> int:
        """How long a robot in a mission waits for its cloud before LAND [ns]."""
        return self.hold_max_ns if flies else max(self.hold_max_ns, GROUND_MIN_NS)

    def too_old(self, beyond_ns: int) -> str:
        """Say by how much the newest command is too old, so many nanoseconds beyond the limit."""
        age, limit = self.command_age_max_ns + beyond_ns, self.command_age_max_ns
        return f"command age {age * 1e-9:.3f} s above {limit * 1e-9:.3f} s"

    def left_alone(self, flies: bool) -> str:
        """Say for how long it has waited."""
        return f"held for {self.alone_max_ns(flies) * 1e-9:g} s without the cloud"

    def inside(self) -> tuple[Vector, Vector]:
        """Give the fence's corners with the margins taken off [m], shape (3,) each."""
        (ax, ay, az), (bx, by, bz) = self.fence_low, self.fence_high
        low = (ax + MARGIN, ay + MARGIN, az + FLOOR_MARGIN)
        return low, (bx - MARGIN, by - MARGIN, bz - MARGIN)
