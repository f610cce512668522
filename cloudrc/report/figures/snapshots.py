"""Draw the figure of snapshots: the robot at six instants, with the board and with pipes cut open.

This needs no 3-D engine: all bodies are small convex polygons, drawn in the order of their depth.
"""

from __future__ import annotations

from itertools import pairwise
from typing import Any, NamedTuple

import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection, PolyCollection
from matplotlib.figure import Figure

from cloudrc.geometry import clearance as body
from cloudrc.geometry.clearance import pipe_index
from cloudrc.geometry.scene import Board, Pipe
from cloudrc.metrics.flight import Array
from cloudrc.metrics.mission import first_touch
from cloudrc.report.figures.style import BLUE, LIGHT, Subject, new_figure

ALT = "Six line drawings of the robot along its path, with the pipes cut open, up to the board."
CAPTION = (
    "Snapshots. The robot at six instants, evenly spaced by distance flown (in a hover, by time) "
    "until the contact or the end. Pose and scale are true, pipes are cut open towards the reader, "
    "floor tiles are 0.5 m wide. The line is the path flown."
)
LETTERS = "abcdef"
"""Letters of the panels."""
MOVING = 0.05
"""Smallest distance in one second that defines a direction of flight [m]; a robot that moves less
counts as hovering."""
REACH = 1.0
"""Distance that a panel shows on either side of the robot [m]."""
ELEVATION, AZIMUTH = np.radians(28.0), np.radians(118.0)
"""Direction from the robot to the eye [rad]: angle above the horizon, and angle from the heading.
The eye is behind the robot, on its right."""
Colour = tuple[float, float, float]
PIPE_COLOUR, WALL_COLOUR = (0.86, 0.88, 0.90), (0.45, 0.48, 0.52)
BASE_COLOUR, ROD_COLOUR, ARM_COLOUR = (0.16, 0.33, 0.55), (0.30, 0.30, 0.32), (0.84, 0.37, 0.0)
ROTOR_COLOUR, BOARD_COLOUR = (0.10, 0.10, 0.12), (0.95, 0.84, 0.58)


class Face(NamedTuple):
    """A flat convex polygon: k corners [m], world frame, shape (k, 3), with colour and opacity."""

    corners: Array
    colour: Colour
    opacity: float = 1.0


def _robot_faces(position: Array, orientation_wxyz: Array) -> list[Face]:
    """Build base, top rod, arm and four rotor discs of the robot at its pose."""
    faces = _box((0.0, 0.0, 0.0), body.BASE_HALF, BASE_COLOUR)
    low, high = (
        body.ROD_RADIUS * _circle(12) + np.array([0.0, 0.0, z])
        for z in (body.ROD_BOTTOM, body.ROD_TOP)
    )
    faces += _strip(np.roll(low, 1, axis=0), np.roll(high, 1, axis=0), ROD_COLOUR)
    faces += [*_strip(low[-2:], high[-2:], ROD_COLOUR), Face(high, ROD_COLOUR)]
    half = body.ARM_LENGTH / 2, body.ARM_RADIUS, body.ARM_RADIUS
    faces += _box((body.ARM_LENGTH / 2, 0.0, body.ARM_HEIGHT), half, ARM_COLOUR)
    for x, y in ((1, 0), (0, 1), (-1, 0), (0, -1)):
        hub = np.array([x * body.ROTOR_ARM, y * body.ROTOR_ARM, body.ROTOR_HEIGHT])
        # The model has no struts, but without them the rotor discs would float.
        strut = *(abs(end) * body.ROTOR_ARM / 2 + 0.006 for end in (x, y)), 0.006
        faces += _box(hub * (0.5, 0.5, 1.0), strut, ROD_COLOUR)
        faces.append(Face(hub + body.ROTOR_RADIUS * _circle(28), ROTOR_COLOUR, 0.35))
    points = body.Spheres(np.concatenate([face.corners for face in faces]), np.zeros(0))
    placed = body.place_points(points, position[None], orientation_wxyz[None])[0]
    corners = np.split(placed, np.cumsum([len(face.corners) for face in faces])[:-1])
    return [face._replace(corners=each) for face, each in zip(faces, corners, strict=True)]


def pipe_faces(pipe: Pipe, towards_eye: Array, near: Array, reach: float) -> list[Face]:
    """Build the half of a pipe that faces away from the eye, cut open along its axis.

    Args:
        pipe: The whole pipe.
        towards_eye: Unit vector from the scene to the eye, shape (3,).
        near: Centre of the visible part [m], shape (3,).
        reach: Visible length along the pipe on either side of the centre [m].
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
    inner = centre + stations[:, None, None] * axis + pipe.inner * away
    outer = inner + (pipe.outer - pipe.inner) * away
    faces = []
    for ring, following in pairwise(inner):
        faces += _strip(ring, following, PIPE_COLOUR)
    for edge in (0, -1):
        faces += _strip(inner[:, edge], outer[:, edge], WALL_COLOUR)
    for rim, reached in ((0, begin <= -pipe.length / 2), (-1, end >= pipe.length / 2)):
        if reached:
            faces += _strip(inner[rim], outer[rim], WALL_COLOUR)
    return faces


def _strip(first: Array, second: Array, colour: Colour) -> list[Face]:
    """Build the faces between two lines of n points, shape (n, 3)."""
    corners = np.stack([first[:-1], second[:-1], second[1:], first[1:]], axis=1)
    return [Face(each, colour) for each in corners]


def is_inside_pipe(face: Face, other: Pipe) -> bool:
    """Tell whether a face cut through a pipe's wall lies inside another pipe that meets the pipe.

    Such a face is not drawn: sorted by depth, it would appear between faces of the other pipe.
    """
    offset = face.corners.mean(axis=0) - np.array(other.centre)
    along = float(offset @ np.array(other.axis))
    across = float(np.linalg.norm(offset - along * np.array(other.axis)))
    inside = abs(along) < other.length / 2 and across < other.outer
    return face.colour == WALL_COLOUR and inside


def _board_faces(board: Board) -> list[Face]:
    """Build the board, 5 cm thick behind its front face."""
    half = np.array([0.025, (board.y[1] - board.y[0]) / 2, (board.z[1] - board.z[0]) / 2])
    centre = np.array([board.x + 0.025, sum(board.y) / 2, sum(board.z) / 2])
    return _box(centre, half, BOARD_COLOUR)


def _box(centre: Any, half: Any, colour: Colour) -> list[Face]:
    """Build a box from its centre and half sizes [m], shape (3,)."""
    faces = []
    for axis in range(3):
        u, v = (axis + 1) % 3, (axis + 2) % 3
        for side in (-1.0, 1.0):
            corners = np.zeros((4, 3))
            corners[:, axis] = side
            corners[:, u], corners[:, v] = (-1, 1, 1, -1), (-1, -1, 1, 1)
            faces.append(Face(np.array(centre) + corners * half, colour))
    return faces


def _circle(count: int) -> Array:
    angle = np.arange(count) * (2 * np.pi / count)
    return np.stack([np.cos(angle), np.sin(angle), np.zeros(count)], axis=1)


class _View:
    """A parallel projection of what is near the robot, on the axes of a panel."""

    def __init__(self, axes: Axes, centre: Array, heading: float) -> None:
        """Look at `centre` [m], shape (3,), a robot with a `heading` [rad]."""
        azimuth = heading - AZIMUTH
        across = np.cos(ELEVATION)
        self.towards = np.array(
            [across * np.cos(azimuth), across * np.sin(azimuth), np.sin(ELEVATION)]
        )
        self._right = np.array([-np.sin(azimuth), np.cos(azimuth), 0.0])
        self._up = np.cross(self.towards, self._right)
        self._axes, self._centre = axes, centre

    def project(self, points: Array) -> Array:
        """Project points [m], shape (..., 3), to the picture, shape (..., 2)."""
        seen = points - self._centre
        return np.stack([seen @ self._right, seen @ self._up], axis=-1)

    def draw_floor(self, height: float) -> None:
        """Draw the joints of the tiles around the robot."""
        x, y = (np.round(self._centre[:2] * 2) / 2).tolist()
        offsets = np.arange(-3.0, 3.5, 0.5)
        lines = [np.array([[x + d, y - 3, height], [x + d, y + 3, height]]) for d in offsets]
        lines += [np.array([[x - 3, y + d, height], [x + 3, y + d, height]]) for d in offsets]
        seen = [self.project(line) for line in lines]
        self._axes.add_collection(LineCollection(seen, colors=LIGHT, lw=0.4, zorder=0))

    def draw_path(self, path: Array) -> None:
        """Draw the part of the path flown since the robot entered the picture."""
        far = np.flatnonzero(np.linalg.norm(path - self._centre, axis=1) > 1.5 * REACH)
        seen = self.project(path[far[-1] if len(far) else 0 :])
        self._axes.plot(seen[:, 0], seen[:, 1], color=BLUE, lw=1.0, zorder=2)

    def draw_faces(self, faces: list[Face], zorder: int) -> None:
        """Draw faces from back to front, shaded by their angle to the light."""
        polygons, colours = [], []
        for face in sorted(faces, key=lambda face: float((face.corners @ self.towards).mean())):
            polygons.append(self.project(face.corners))
            a, b, c = face.corners[:3]
            normal = np.cross(b - a, c - b)
            length = float(np.linalg.norm(normal)) * np.sqrt(2)
            light = 0.62 + 0.38 * abs(float(normal @ (self.towards + self._up))) / length
            colours.append((*(light * np.array(face.colour)), face.opacity))
        drawn = PolyCollection(
            polygons, facecolors=colours, edgecolors=colours, lw=0.15, zorder=zorder
        )
        self._axes.add_collection(drawn)


def draw(subject: Subject) -> Figure:
    """Draw the panels."""
    figure = new_figure(4.1)
    panels = figure.subplots(2, len(LETTERS) // 2).flat
    rows = _instants(subject)
    for n, axes in enumerate(panels):
        axes.set_axis_off()
        axes.set_aspect("equal")
        axes.set_xlim(-REACH, REACH)
        axes.set_ylim(-REACH * 0.82, REACH * 0.72)
        if len(rows):
            _draw_panel(axes, subject, rows[n], LETTERS[n])
    return figure


def _instants(subject: Subject) -> Array:
    """Choose rows of the true states, evenly spaced by distance flown or, in a hover, by time."""
    truth, touch = subject.flight.truth, first_touch(subject.flight)
    stamps = truth["stamp_ns"]
    if touch is not None:
        stamps = stamps[stamps <= touch["stamp_ns"]]
    if not len(stamps):
        return np.zeros(0, dtype=np.int64)
    steps = np.linalg.norm(np.diff(truth["position"][: len(stamps)], axis=0), axis=1)
    way = np.concatenate([[0.0], np.cumsum(steps)])
    measure = way if way[-1] > REACH else np.arange(len(stamps), dtype=float)
    wanted = measure[-1] * np.arange(1, len(LETTERS) + 1) / len(LETTERS)
    rows: Array = np.minimum(np.searchsorted(measure, wanted), len(stamps) - 1)
    return rows


def _draw_panel(axes: Axes, subject: Subject, row: int, letter: str) -> None:
    flight, scene = subject.flight, subject.flight.scene
    positions, orientation = flight.truth["position"], flight.truth["orientation_wxyz"][row]
    position = positions[row]
    title = f"({letter}) {flight.seconds(flight.truth['stamp_ns'][row]):.1f} s"
    # Look along the pipe that contains the robot, else along the robot's path.
    inside = pipe_index(scene, position[None])[0]
    if inside >= 0:
        x, y, _ = scene.pipes[inside].axis
        name = scene.pipes[inside].name.replace("_", " ")
        title += f", {name}, clearance {flight.clearance[row]:.2f} m"
    else:
        x, y, _ = position - positions[max(row - 100, 0)]
        if np.hypot(x, y) < MOVING:
            x, y = 1.0, 0.0
    axes.set_title(title, loc="left", fontsize=8.5)
    view = _View(axes, position, float(np.arctan2(y, x)))
    around = [
        face
        for pipe in scene.pipes
        for face in pipe_faces(pipe, view.towards, position, REACH)
        if not any(is_inside_pipe(face, other) for other in scene.pipes if other is not pipe)
    ]
    around += _board_faces(scene.board) if scene.board else []
    view.draw_floor(scene.floor)
    view.draw_faces(around, zorder=1)
    view.draw_path(positions[: row + 1])
    view.draw_faces(_robot_faces(position, orientation), zorder=3)
