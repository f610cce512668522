"""Build robot, pipes and board from flat convex polygons, for the overview figure and viewers."""

from __future__ import annotations

from typing import Any, NamedTuple, TypeAlias

import numpy as np

from cloudrc.geometry import clearance as body
from cloudrc.geometry.scene import Board, Pipe
from cloudrc.metrics.flight import Array

Colour: TypeAlias = tuple[float, float, float]
BASE, ROD, ARM = (0.16, 0.33, 0.55), (0.30, 0.30, 0.32), (0.84, 0.37, 0.0)
ROTOR, BOARD, PIPE = (0.10, 0.10, 0.12), (0.95, 0.84, 0.58), (0.86, 0.88, 0.90)
PATH = (0.0, 0.45, 0.70)
"""Colours: red, green, blue in [0, 1]."""


class Face(NamedTuple):
    """A flat convex polygon or a line: k corners [m], shape (k, 3), k >= 2.

    `opacity` is in [0, 1].
    """

    corners: Array
    colour: Colour
    opacity: float = 1.0


DRAWN = "pelican"
"""Robot whose shape is known here; all others are drawn as a marker."""
MARKER_HALF, MARKER_NOSE = (0.10, 0.06, 0.03), 0.06
"""Half the size of the marker, and the length of its nose, which points along +x [m]."""


def robot_faces(robot: str = DRAWN) -> list[Face]:
    """Return the faces that draw a robot, given as in `world.robot`, in its body frame.

    A robot other than `DRAWN` is drawn as a small box with a nose, not to scale.
    """
    if robot != DRAWN:
        nose = (MARKER_HALF[0] + MARKER_NOSE / 2, 0.0, 0.0)
        return [
            *_box((0.0, 0.0, 0.0), MARKER_HALF, BASE),
            *_box(nose, (MARKER_NOSE / 2, 0.02, 0.02), ARM),
        ]
    rod, arm = (body.ROD_TOP - body.ROD_BOTTOM) / 2, body.ARM_LENGTH / 2
    wide, thin = body.ROD_RADIUS, body.ARM_RADIUS
    faces = _box((0.0, 0.0, 0.0), body.BASE_HALF, BASE)
    faces += _box((0.0, 0.0, body.ROD_BOTTOM + rod), (wide, wide, rod), ROD)
    faces += _box((arm, 0.0, body.ARM_HEIGHT), (arm, thin, thin), ARM)
    angle = np.linspace(0.0, 2 * np.pi, 20, endpoint=False)
    disc = body.ROTOR_RADIUS * np.stack([np.cos(angle), np.sin(angle), 0 * angle], axis=1)
    for x, y in ((1, 0), (0, 1), (-1, 0), (0, -1)):
        hub = np.array([x * body.ROTOR_ARM, y * body.ROTOR_ARM, body.ROTOR_HEIGHT])
        # The simulated robot has no struts; here they connect the rotors to the base.
        strut = *(abs(end) * body.ROTOR_ARM / 2 + 0.006 for end in (x, y)), 0.006
        faces += _box(hub * (0.5, 0.5, 1.0), strut, ROD)
        faces.append(Face(hub + disc, ROTOR, 0.35))
    return faces


def board_faces(board: Board) -> list[Face]:
    """Build the board, a wall that the arm can touch, in the world frame.

    The board is translucent, because the arm may be behind it.
    """
    low = np.array([board.x, board.y[0], board.z[0]])
    high = np.array([board.x + 0.05, board.y[1], board.z[1]])
    faces = _box((low + high) / 2, (high - low) / 2, BOARD)
    return [face._replace(opacity=0.6) for face in faces]


def bore(pipe: Pipe, towards: Array, half_angle: float, count: int, stations: int) -> Array:
    """Return points on the inner face of a pipe [m], world frame, shape (stations, count, 3).

    The stations are cross-sections at equal distances along the pipe. The `count` points of each
    are on an arc of twice the `half_angle` [rad]. The middle of the arc is opposite to the
    direction `towards`, shape (3,).
    """
    centre, axis = np.array(pipe.centre), np.array(pipe.axis)
    up = towards - (towards @ axis) * axis
    up /= np.linalg.norm(up)
    angles = np.linspace(-half_angle, half_angle, count)[:, None]
    away = -np.cos(angles) * up + np.sin(angles) * np.cross(axis, up)
    along = np.linspace(-pipe.length / 2, pipe.length / 2, stations)
    return np.asarray(centre + along[:, None, None] * axis + pipe.inner * away)


def strip(first: Array, second: Array, colour: Colour, opacity: float = 1.0) -> list[Face]:
    """Build n - 1 faces between two lines of points, `first` and `second` [m], shape (n, 3).

    `opacity` is in [0, 1].
    """
    corners = np.stack([first[:-1], second[:-1], second[1:], first[1:]], axis=1)
    return [Face(each, colour, opacity) for each in corners]


def _box(centre: Any, half: Any, colour: Colour) -> list[Face]:
    faces = []
    for axis in range(3):
        for side in (-1.0, 1.0):
            corners = np.insert([(-1, -1), (1, -1), (1, 1), (-1, 1)], axis, side, axis=1)
            faces.append(Face(np.array(centre) + corners * half, colour))
    return faces
