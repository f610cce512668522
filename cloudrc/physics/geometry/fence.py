# SPDX-License-Identifier: Apache-2.0

"""The fence of the guard: the box that the robot's base may not leave.

A fence is a fact of a scene: `<custom><numeric name="fence" data="x0 y0 z0 x1 y1 z1"/></custom>`
in its file, else the box around spawn and geoms with `SPACE` on all sides. The key world.fence_m
replaces it.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import TypeAlias

from cloudrc.wire.messages import Vector

Corners: TypeAlias = tuple[Vector, Vector]
"""Corners of a box with the smallest and the largest coordinates [m], world frame."""
FLOOR_MARGIN = 0.35
"""Smallest height above the fence's floor at which the guard holds the robot [m]. At a smaller
height a tilted robot would touch the ground."""
WALL_MARGIN = 0.2
"""Distance from the walls and the ceiling of the fence at which the guard stops the robot [m]."""
TAKE_OFF_MARGIN = 0.5
"""Smallest distance from the fence's walls at which a robot may take off after its actuators were
switched off [m]. A tilted robot slides up to 0.35 m along the floor before it rises. This distance
was measured with `pytest -m "" -k scrapes tests/world`."""
SPACE = 3.0
"""Distance of the fence from the geoms of a scene that declares no fence [m]."""


@dataclass(frozen=True)
class Fence:
    """A box, and the box inside it in which the guard lets the robot fly; [m], world frame."""

    low: Vector  # corner with the smallest coordinates [m]; the ground is at its height
    high: Vector  # corner with the largest coordinates [m]
    ground: float | None = None  # height of a base that stays on the ground [m]; None: it may fly

    @cached_property
    def inner_low(self) -> Vector:
        """Lower corner of the box in which the guard lets the robot fly [m], world frame."""
        x, y, z = self.low
        lowest = z + FLOOR_MARGIN if self.ground is None else self.ground
        return (x + WALL_MARGIN, y + WALL_MARGIN, lowest)

    @cached_property
    def inner_high(self) -> Vector:
        """Upper corner of the box in which the guard lets the robot fly [m], world frame."""
        x, y, z = self.high
        highest = z - WALL_MARGIN if self.ground is None else self.ground
        return (x - WALL_MARGIN, y - WALL_MARGIN, highest)

    @property
    def axes(self) -> slice:
        """Axes that the fence limits: x, y and z, or x and y if the robot stays on the ground."""
        return slice(3 if self.ground is None else 2)

    def room(self, spawn: Vector) -> float:
        """Return the longest way along x or y from the spawn to where a robot may take off [m]."""
        walls = zip(self.low[:2], spawn[:2], self.high[:2], strict=True)
        return max(max(at - low, high - at) for low, at, high in walls) - TAKE_OFF_MARGIN


def order_of(corners: Corners) -> str:
    """Return what is wrong with the order of a fence's corners [m]; "" if nothing is."""
    low, high = corners
    wrong = [axis for axis, a, b in zip("xyz", low, high, strict=True) if not a < b]
    if not wrong:
        return ""
    return f"{', '.join(wrong)} must rise from the first corner to the second; exchange them"
