"""The fence of the guard: the box that the robot's base may not leave."""

from __future__ import annotations

from cloudrc.messages import Vector

LOW: Vector = (-3.0, -8.5, 0.0)
HIGH: Vector = (9.2, 5.5, 2.5)
"""Opposite corners LOW and HIGH of the fence [m], world frame.
Source: docs/reference/plant.md, "Fence of the guard"."""
FLOOR_MARGIN = 0.35
"""Smallest height above the fence's floor at which the guard holds the robot [m]. At a smaller
height a tilted robot would touch the ground."""
WALL_MARGIN = 0.2
"""Distance from the walls and the ceiling of the fence at which the guard stops the robot [m]."""
INNER_LOW: Vector = (LOW[0] + WALL_MARGIN, LOW[1] + WALL_MARGIN, LOW[2] + FLOOR_MARGIN)
INNER_HIGH: Vector = (HIGH[0] - WALL_MARGIN, HIGH[1] - WALL_MARGIN, HIGH[2] - WALL_MARGIN)
"""Opposite corners, INNER_LOW and INNER_HIGH, of the box in which the guard lets the robot fly [m],
world frame."""


def inside(position: Vector) -> bool:
    """Return whether a base at `position` [m], world frame, shape (3,), is inside the fence."""
    return all(low <= value <= high for low, value, high in zip(LOW, position, HIGH, strict=True))
