"""Represent the robot by points in its body frame, and move them to its pose.

Source: docs/reference/plant.md, "Robot", "Key points for clearance".
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

BASE_HALF = (0.05, 0.05, 0.10)
"""Half sizes of the base's box [m], body frame."""
ARM_LENGTH, ARM_HEIGHT, ARM_RADIUS = 0.40, 0.17, 0.01
"""The arm, which points along +x: length from the z axis to the tip, height (z), radius [m], body
frame."""
ROTOR_ARM, ROTOR_HEIGHT, ROTOR_RADIUS, ROTOR_HALF_THICKNESS = 0.21, 0.05, 0.128, 0.0025
"""The rotors: distance of a centre from the z axis, height (z), radius, half thickness [m], body
frame."""
ROD_RADIUS, ROD_BOTTOM, ROD_TOP = 0.05, 0.06, 0.18
"""The top rod: radius, heights (z) of its lower and upper end [m], body frame."""


@dataclass(frozen=True, slots=True)
class Spheres:
    """Spheres that represent the robot.

    Attributes:
        positions: Centres [m], body frame, shape (k, 3).
        radii: Radii [m], shape (k,).
    """

    positions: Array
    radii: Array


def key_points() -> Spheres:
    """Return the 225 points that determine the clearance: rotors, arm, base box, top rod."""
    return _points([*_rotor_rings(), _box(2, 2, 2), *_rod_rings()], arm=9)


def robot_points() -> Spheres:
    """Return points of the whole robot, dense enough to find every overlap with a wall.

    Neighbouring points are at most 0.034 m apart, less than the 0.038 m of a wall's thickness.
    """
    return _points([*_rotor_rings(), *_rod_rings(), _box(4, 4, 7)], arm=21)


def place_points(points: Spheres, positions: Array, orientations_wxyz: Array) -> Array:
    """Transform the robot's points to the world frame.

    Args:
        points: Points in the body frame.
        positions: Positions of the base [m], world frame, shape (n, 3).
        orientations_wxyz: Orientations of the base, unit quaternions, body to world, shape (n, 4).

    Returns:
        Centres [m], world frame, shape (n, k, 3).
    """
    w, x, y, z = np.moveaxis(orientations_wxyz, -1, 0)
    rotation = np.empty((len(w), 3, 3))
    rotation[:, 0] = np.stack(
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)], 1
    )
    rotation[:, 1] = np.stack(
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)], 1
    )
    rotation[:, 2] = np.stack(
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)], 1
    )
    placed: Array = points.positions @ rotation.transpose(0, 2, 1)
    placed += positions[:, None, :]
    return placed


def _rotor_rings() -> list[Array]:
    return [
        _ring(x, y, height, ROTOR_RADIUS, 24)
        for x, y in ((ROTOR_ARM, 0), (0, ROTOR_ARM), (-ROTOR_ARM, 0), (0, -ROTOR_ARM))
        for height in (ROTOR_HEIGHT - ROTOR_HALF_THICKNESS, ROTOR_HEIGHT + ROTOR_HALF_THICKNESS)
    ]


def _rod_rings() -> list[Array]:
    return [_ring(0, 0, height, ROD_RADIUS, 8) for height in (ROD_BOTTOM, ROD_TOP)]


def _points(parts: list[Array], arm: int) -> Spheres:
    along = np.linspace(0, ARM_LENGTH, arm)
    arm_points = np.stack([along, np.zeros(arm), np.full(arm, ARM_HEIGHT)], axis=1)
    positions = np.concatenate([arm_points, *parts])
    radii = np.zeros(len(positions))
    radii[:arm] = ARM_RADIUS
    return Spheres(positions, radii)


def _ring(x: float, y: float, z: float, radius: float, count: int) -> Array:
    angle = np.arange(count) * (2 * np.pi / count)
    return np.stack(
        [x + radius * np.cos(angle), y + radius * np.sin(angle), np.full(count, z)], axis=1
    )


def _box(nx: int, ny: int, nz: int) -> Array:
    axes = [np.linspace(-half, half, n) for half, n in zip(BASE_HALF, (nx, ny, nz), strict=True)]
    return np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
