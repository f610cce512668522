"""The Pelican as spheres, for its distance from obstacles and for the check of paths.

Each function returns an array with a row per sphere: its centre (x, y, z) in the body frame and its
radius [m].

Source: docs/reference/plant.md, "Robot", "Key points for clearance".
"""

from __future__ import annotations

from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

Array: TypeAlias = NDArray[np.float64]

# Dimensions [m], body frame. The arm points along +x; heights are along z.
BASE_HALF = (0.05, 0.05, 0.10)
ARM_LENGTH, ARM_HEIGHT, ARM_RADIUS = 0.40, 0.17, 0.01
ROTOR_ARM, ROTOR_HEIGHT, ROTOR_RADIUS, ROTOR_HALF_THICKNESS = 0.21, 0.05, 0.128, 0.0025
ROD_RADIUS, ROD_BOTTOM, ROD_TOP = 0.05, 0.06, 0.18


def few() -> Array:
    """Return the 225 spheres (on arm, rotors, base box and top rod) that give the clearance [m]."""
    return _points(_box(2, 2, 2), arm=9)


def dense() -> Array:
    """Return spheres of the whole robot [m], dense enough to find every overlap with a wall.

    Neighbouring points are at most 0.034 m apart, less than a wall's thickness of 0.038 m.
    """
    return _points(_box(4, 4, 7), arm=21)


def _points(box: Array, arm: int) -> Array:
    along = np.linspace(0, ARM_LENGTH, arm)
    parts = [np.stack([along, np.zeros(arm), np.full(arm, ARM_HEIGHT)], axis=1)]
    for x, y in ((ROTOR_ARM, 0), (0, ROTOR_ARM), (-ROTOR_ARM, 0), (0, -ROTOR_ARM)):
        for side in (-ROTOR_HALF_THICKNESS, ROTOR_HALF_THICKNESS):
            parts.append(_ring(x, y, ROTOR_HEIGHT + side, ROTOR_RADIUS, 24))
    parts += [box, *(_ring(0, 0, z, ROD_RADIUS, 8) for z in (ROD_BOTTOM, ROD_TOP))]
    positions = np.concatenate(parts)
    radii = np.where(np.arange(len(positions)) < arm, ARM_RADIUS, 0.0)
    return np.column_stack([positions, radii])


def _ring(x: float, y: float, z: float, radius: float, count: int) -> Array:
    angle = np.arange(count) * (2 * np.pi / count)
    return np.stack(
        [x + radius * np.cos(angle), y + radius * np.sin(angle), np.full(count, z)], axis=1
    )


def _box(nx: int, ny: int, nz: int) -> Array:
    axes = [np.linspace(-half, half, n) for half, n in zip(BASE_HALF, (nx, ny, nz), strict=True)]
    return np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
