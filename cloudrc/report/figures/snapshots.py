"""Draw the figure of snapshots: the robot at six instants, with the board and with pipes cut open.

All bodies consist of small convex polygons, which are drawn from back to front.
"""

from __future__ import annotations

from itertools import pairwise
from typing import Any, NamedTuple

import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import PolyCollection
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
"""The letters of the panels, one per snapshot."""
MOVING = 0.05
"""A robot that flies less than this distance horizontally in one second [m] counts as hovering."""
REACH = 1.0
"""Half the width of a panel, which shows the robot in its centre [m]."""
ELEVATION, AZIMUTH = np.radians(28.0), np.radians(118.0)
"""Direction from the robot to the viewer [rad]: angle above the horizontal plane, and horizontal
angle from the heading. The viewer is behind the robot, to its right."""
Colour = tuple[float, float, float]
PIPE_COLOUR, WALL_COLOUR = (0.86, 0.88, 0.90), (0.45, 0.48, 0.52)
BASE_COLOUR, ROD_COLOUR, ARM_COLOUR = (0.16, 0.33, 0.55), (0.30, 0.30, 0.32), (0.84, 0.37, 0.0)
ROTOR_COLOUR, BOARD_COLOUR = (0.10, 0.10, 0.12), (0.95, 0.84, 0.58)


class Face(NamedTuple):
    """A flat convex polygon: k corners [m], world frame, shape (k, 3); opacity in [0, 1]."""

    corners: Array
    colour: Colour
    opacity: float = 1.0


def _robot_faces(position: Array, orientation_wxyz: Array) -> list[Face]:
    rod, arm = (body.ROD_TOP - body.ROD_BOTTOM) / 2, body.ARM_LENGTH / 2
    wide, thin = body.ROD_RADIUS, body.ARM_RADIUS
    faces = _box((0.0, 0.0, 0.0), body.BASE_HALF, BASE_COLOUR)
    faces += _box((0.0, 0.0, body.ROD_BOTTOM + rod), (wide, wide, rod), ROD_COLOUR)
    faces += _box((arm, 0.0, body.ARM_HEIGHT), (arm, thin, thin), ARM_COLOUR)
    angle = np.linspace(0.0, 2 * np.pi, 28, endpoint=False)
    disc = body.ROTOR_RADIUS * np.stack([np.cos(angle), np.sin(angle), 0 * angle], axis=1)
    for x, y in ((1, 0), (0, 1), (-1, 0), (0, -1)):
        hub = np.array([x * body.ROTOR_ARM, y * body.ROTOR_ARM, body.ROTOR_HEIGHT])
        # The simulated robot has no struts; in the figure they connect the rotors to the base.
        strut = *(abs(end) * body.ROTOR_ARM / 2 + 0.006 for end in (x, y)), 0.006
        faces += _box(hub * (0.5, 0.5, 1.0), strut, ROD_COLOUR)
        faces.append(Face(hub + disc, ROTOR_COLOUR, 0.35))
    points = body.Spheres(np.concatenate([face.corners for face in faces]), np.zeros(0))
    placed = body.place_points(points, position[None], orientation_wxyz[None])[0]
    corners = np.split(placed, np.cumsum([len(face.corners) for face in faces])[:-1])
    return [face._replace(corners=each) for face, each in zip(faces, corners, strict=True)]


def _pipe_faces(pipe: Pipe, view: _View) -> list[Face]:
    """Build the half of a pipe that is farther from the viewer, as far as the panel shows it."""
    centre, axis = np.array(pipe.centre), np.array(pipe.axis)
    middle = float((view.centre - centre) @ axis)
    begin, end = max(-pipe.length / 2, middle - REACH), min(pipe.length / 2, middle + REACH)
    if begin >= end:
        return []
    up = view.towards - (view.towards @ axis) * axis
    up /= np.linalg.norm(up)
    angles = np.linspace(-np.pi / 2, np.pi / 2, 17)
    away = -np.cos(angles)[:, None] * up + np.sin(angles)[:, None] * np.cross(axis, up)
    stations = np.linspace(begin, end, 1 + max(1, round((end - begin) / 0.25)))
    inner = centre + stations[:, None, None] * axis + pipe.inner * away
    outer = inner + (pipe.outer - pipe.inner) * away
    faces = [
        face for ring, following in pairwise(inner) for face in _strip(ring, following, PIPE_COLOUR)
    ]
    for edge in (0, -1):
        faces += _strip(inner[:, edge], outer[:, edge], WALL_COLOUR)
    return faces


def _strip(first: Array, second: Array, colour: Colour) -> list[Face]:
    """Build n - 1 faces between two lines of n points [m], shape (n, 3)."""
    corners = np.stack([first[:-1], second[:-1], second[1:], first[1:]], axis=1)
    return [Face(each, colour) for each in corners]


def _board_faces(board: Board) -> list[Face]:
    low = np.array([board.x, board.y[0], board.z[0]])
    high = np.array([board.x + 0.05, board.y[1], board.z[1]])
    return _box((low + high) / 2, (high - low) / 2, BOARD_COLOUR)


def _box(centre: Any, half: Any, colour: Colour) -> list[Face]:
    faces = []
    for axis in range(3):
        for side in (-1.0, 1.0):
            corners = np.insert([(-1, -1), (1, -1), (1, 1), (-1, 1)], axis, side, axis=1)
            faces.append(Face(np.array(centre) + corners * half, colour))
    return faces


class _View:
    """A parallel projection of the robot and its surroundings to a panel."""

    def __init__(self, axes: Axes, centre: Array, heading: float) -> None:
        """Look at a robot at `centre` [m], shape (3,), whose direction is `heading` [rad]."""
        azimuth = heading - AZIMUTH
        right = np.array([-np.sin(azimuth), np.cos(azimuth), 0.0])
        self.towards = np.array([*(np.cos(ELEVATION) * right[[1, 0]] * (1, -1)), np.sin(ELEVATION)])
        self.centre, self._axes = centre, axes
        self._sides = np.stack([right, np.cross(self.towards, right)], axis=1)

    def project(self, points: Array) -> Array:
        """Project points [m], world frame, shape (..., 3), to the panel [m], shape (..., 2)."""
        return np.asarray((points - self.centre) @ self._sides)

    def draw_floor(self, height: float) -> None:
        """Draw the grid of floor tiles around the robot; `height` is the z of the floor [m]."""
        x, y = np.round(self.centre[:2] * 2) / 2
        for offset in np.arange(-3.0, 3.5, 0.5):
            for ends in (
                [[x + offset, y - 3, height], [x + offset, y + 3, height]],
                [[x - 3, y + offset, height], [x + 3, y + offset, height]],
            ):
                self._axes.plot(*self.project(np.array(ends)).T, color=LIGHT, lw=0.4, zorder=0)

    def draw_path(self, path: Array) -> None:
        """Draw the part of `path` flown since the robot last entered the region of the panel."""
        far = np.flatnonzero(np.linalg.norm(path - self.centre, axis=1) > 1.5 * REACH)
        seen = self.project(path[far[-1] if len(far) else 0 :])
        self._axes.plot(*seen.T, color=BLUE, lw=1.0, zorder=2)

    def draw_faces(self, faces: list[Face], zorder: int) -> None:
        """Draw faces from back to front; brightest where light meets a face at a right angle."""
        polygons, colours = [], []
        light = (self.towards + self._sides[:, 1]) / np.sqrt(2)
        for face in sorted(faces, key=lambda face: float((face.corners @ self.towards).mean())):
            polygons.append(self.project(face.corners))
            a, b, c = face.corners[:3]
            normal = np.cross(b - a, c - b)
            shade = 0.62 + 0.38 * abs(float(normal @ light)) / float(np.linalg.norm(normal))
            colours.append((*(shade * np.array(face.colour)), face.opacity))
        drawn = PolyCollection(
            polygons, facecolors=colours, edgecolors=colours, lw=0.15, zorder=zorder
        )
        self._axes.add_collection(drawn)


def draw(subject: Subject) -> Figure:
    """Draw the figure with its six panels."""
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
    """Choose six true states: at equal distances flown or, if the robot hovers, at equal times."""
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
    around = [face for pipe in scene.pipes for face in _pipe_faces(pipe, view)]
    around += _board_faces(scene.board) if scene.board else []
    view.draw_floor(scene.floor)
    view.draw_faces(around, zorder=1)
    view.draw_path(positions[: row + 1])
    view.draw_faces(_robot_faces(position, orientation), zorder=3)
