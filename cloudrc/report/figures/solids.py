"""Robot, pipes and board as flat polygons: poses and the scene go in, faces in the world come out.

For drawings without a 3-D engine: few, convex, small enough to be sorted by their depth.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from cloudrc.geometry import robot as body
from cloudrc.geometry.scene import Board, Pipe
from cloudrc.metrics.flight import Array

PIPE_COLOUR, WALL_COLOUR = (0.86, 0.88, 0.90), (0.45, 0.48, 0.52)
BASE_COLOUR, ROD_COLOUR, ARM_COLOUR = (0.16, 0.33, 0.55), (0.30, 0.30, 0.32), (0.84, 0.37, 0.0)
ROTOR_COLOUR, BOARD_COLOUR = (0.10, 0.10, 0.12), (0.95, 0.84, 0.58)
Colour = tuple[float, float, float]


@dataclass(frozen=True, slots=True)
class Face:
    """A flat convex polygon.

    Attributes:
        corners: [m], shape (k, 3).
        colour: Red, green, blue, each in [0, 1].
        opacity: In [0, 1].
    """

    corners: Array
    colour: Colour
    opacity: float = 1.0


def robot_faces(position: Array, orientation_wxyz: Array) -> list[Face]:
    """Build the robot: base, top rod, arm and four rotor discs.

    Args:
        position: Of the base [m], world frame, shape (3,).
        orientation_wxyz: Unit quaternion, body to world, shape (4,).
    """
    faces = _box(np.zeros(3), np.array(body.BASE_HALF), BASE_COLOUR)
    rod_centre = np.array([0.0, 0.0, (body.ROD_BOTTOM + body.ROD_TOP) / 2])
    rod_half = np.array([body.ROD_RADIUS, body.ROD_RADIUS, (body.ROD_TOP - body.ROD_BOTTOM) / 2])
    faces += _cylinder(rod_centre, rod_half, ROD_COLOUR)
    arm = np.array([body.ARM_LENGTH / 2, body.ARM_RADIUS, body.ARM_RADIUS])
    faces += _box(np.array([body.ARM_LENGTH / 2, 0.0, body.ARM_HEIGHT]), arm, ARM_COLOUR)
    for x, y in ((1, 0), (0, 1), (-1, 0), (0, -1)):
        hub = np.array([x * body.ROTOR_ARM, y * body.ROTOR_ARM, body.ROTOR_HEIGHT])
        # A strut from the base to the hub: not in the model, but without it the discs float.
        strut = np.array([abs(x) * body.ROTOR_ARM / 2 + 0.006, abs(y) * body.ROTOR_ARM / 2 + 0.006])
        faces += _box(hub * (0.5, 0.5, 1.0), np.array([*strut, 0.006]), ROD_COLOUR)
        disc = hub + body.ROTOR_RADIUS * _circle(28)
        faces.append(Face(disc, ROTOR_COLOUR, 0.35))
    points = body.Points(np.concatenate([face.corners for face in faces]), np.zeros(0))
    placed = body.place(points, position[None], orientation_wxyz[None])[0]
    splits = np.cumsum([len(face.corners) for face in faces])[:-1]
    return [
        Face(corners, face.colour, face.opacity)
        for corners, face in zip(np.split(placed, splits), faces, strict=True)
    ]


def pipe_faces(pipe: Pipe, towards_eye: Array, near: Array, reach: float) -> list[Face]:
    """Build the half of a pipe that lies away from the eye, cut open along its axis.

    Args:
        pipe: Whole.
        towards_eye: Unit vector from the scene to the eye, shape (3,).
        near: Middle of what is to be seen [m], shape (3,).
        reach: How far along the pipe to either side of it [m].
    """
    centre, axis = np.array(pipe.centre), np.array(pipe.axis)
    middle = float((near - centre) @ axis)
    begin, end = max(-pipe.length / 2, middle - reach), min(pipe.length / 2, middle + reach)
    if begin >= end:
        return []
    up = towards_eye - (towards_eye @ axis) * axis
    up /= np.linalg.norm(up)
    angles = np.linspace(-np.pi / 2, np.pi / 2, 17)
    away = -np.cos(angles)[:, None] * up + np.sin(angles)[:, None] * np.cross(axis, up)
    stations = np.linspace(begin, end, 1 + max(1, round((end - begin) / 0.25)))
    rings = centre + stations[:, None, None] * axis + pipe.inner * away
    walls = rings + (pipe.outer - pipe.inner) * away
    faces = []
    for s in range(len(stations) - 1):
        for a in range(len(angles) - 1):
            quad = [rings[s, a], rings[s + 1, a], rings[s + 1, a + 1], rings[s, a + 1]]
            faces.append(Face(np.array(quad), PIPE_COLOUR))
        for a in (0, -1):
            quad = [rings[s, a], rings[s + 1, a], walls[s + 1, a], walls[s, a]]
            faces.append(Face(np.array(quad), WALL_COLOUR))
    for s, reached in ((0, begin <= -pipe.length / 2), (-1, end >= pipe.length / 2)):
        for a in range(len(angles) - 1) if reached else ():
            quad = [rings[s, a], rings[s, a + 1], walls[s, a + 1], walls[s, a]]
            faces.append(Face(np.array(quad), WALL_COLOUR))
    return faces


def is_swallowed(face: Face, other: Pipe) -> bool:
    """Say whether a cut through a pipe's wall lies in another pipe: where two meet there is none.

    Sorted by depth such a face would show in patches between the faces of the other.
    """
    if face.colour != WALL_COLOUR:
        return False
    offset = face.corners.mean(axis=0) - np.array(other.centre)
    along = float(offset @ np.array(other.axis))
    across = float(np.linalg.norm(offset - along * np.array(other.axis)))
    return abs(along) < other.length / 2 and across < other.outer


def board_faces(board: Board) -> list[Face]:
    """Build the board, 5 cm thick behind its front face."""
    half = np.array([0.025, (board.y[1] - board.y[0]) / 2, (board.z[1] - board.z[0]) / 2])
    centre = np.array([board.x + 0.025, sum(board.y) / 2, sum(board.z) / 2])
    return _box(centre, half, BOARD_COLOUR)


def _box(centre: Array, half: Array, colour: Colour) -> list[Face]:
    faces = []
    for axis in range(3):
        u, v = (axis + 1) % 3, (axis + 2) % 3
        for side in (-1.0, 1.0):
            corners = np.zeros((4, 3))
            corners[:, axis] = side
            corners[:, u], corners[:, v] = (-1, 1, 1, -1), (-1, -1, 1, 1)
            faces.append(Face(centre + corners * half, colour))
    return faces


def _cylinder(centre: Array, half: Array, colour: Colour) -> list[Face]:
    """Upright, its sides as flat staves, with its lid."""
    ring = _circle(12) * half
    low, high = centre + ring - (0, 0, half[2]), centre + ring + (0, 0, half[2])
    sides = [
        Face(np.array([low[i - 1], low[i], high[i], high[i - 1]]), colour) for i in range(len(ring))
    ]
    return [*sides, Face(high, colour)]


def _circle(count: int) -> Array:
    angle = np.arange(count) * (2 * np.pi / count)
    return np.stack([np.cos(angle), np.sin(angle), np.zeros(count)], axis=1)
