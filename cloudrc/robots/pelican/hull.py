# SPDX-License-Identifier: Apache-2.0

"""The Pelican as spheres, for its distance from obstacles.

`few` returns an array with a row per sphere: its centre (x, y, z) in the body frame and its
radius [m].

Source: docs/reference/plant.md, "Robot", "Key points for clearance".
"""

from __future__ import annotations

from itertools import product
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

Array: TypeAlias = NDArray[np.float64]

# Dimensions [m], body frame. The arm points along +x; heights are along z.
BASE_HALF = (0.05, 0.05, 0.10)
ARM_LENGTH, ARM_HEIGHT, ARM_RADIUS = 0.40, 0.17, 0.01
ARM_COUNT = 9  # spheres on the arm
ROTOR_ARM, ROTOR_HEIGHT, ROTOR_RADIUS, ROTOR_HALF_THICKNESS = 0.21, 0.05, 0.128, 0.0025
ROD_RADIUS, ROD_BOTTOM, ROD_TOP = 0.05, 0.06, 0.18


def few() -> Array:
    """Return the 225 spheres (on arm, rotors, base box and top rod) that give the clearance [m]."""
    along = np.linspace(0, ARM_LENGTH, ARM_COUNT)
    parts = [np.stack([along, 0 * along, np.full(ARM_COUNT, ARM_HEIGHT)], axis=1)]
    for x, y in ((ROTOR_ARM, 0), (0, ROTOR_ARM), (-ROTOR_ARM, 0), (0, -ROTOR_ARM)):
        for side in (-ROTOR_HALF_THICKNESS, ROTOR_HALF_THICKNESS):
            parts.append(_ring(x, y, ROTOR_HEIGHT + side, ROTOR_RADIUS, 24))
    corners = np.array([*product((-1, 1), repeat=3)])
    parts += [corners * BASE_HALF, *(_ring(0, 0, z, ROD_RADIUS, 8) for z in (ROD_BOTTOM, ROD_TOP))]
    positions = np.concatenate(parts)
    radii = np.where(np.arange(len(positions)) < ARM_COUNT, ARM_RADIUS, 0.0)
    return np.column_stack([positions, radii])


def _ring(x: float, y: float, z: float, radius: float, count: int) -> Array:
    angle = np.arange(count) * (2 * np.pi / count)
    return np.stack(
        [x + radius * np.cos(angle), y + radius * np.sin(angle), np.full(count, z)], axis=1
    )
