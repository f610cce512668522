"""Draw the figure of snapshots: the robot at six instants, with the board and with pipes cut open.

This needs no 3-D engine: all bodies are small convex polygons, drawn in the order of their depth.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection, PolyCollection
from matplotlib.figure import Figure

from cloudrc.geometry import clearance as body
from cloudrc.geometry.clearance import pipe_index
from cloudrc.geometry.scene import Board, Pipe
from cloudrc.metrics.flight import Array
from cloudrc.metrics.mission import first_touch
from cloudrc.report.figures.style import BLUE, LIGHT, PAGE, Subject, new_figure

PIPE_COLOUR, WALL_COLOUR = (0.86, 0.88, 0.90), (0.45, 0.48, 0.52)
BASE_COLOUR, ROD_COLOUR, ARM_COLOUR = (0.16, 0.33, 0.55), (0.30, 0.30, 0.32), (0.84, 0.37, 0.0)
ROTOR_COLOUR, BOARD_COLOUR = (0.10, 0.10, 0.12), (0.95, 0.84, 0.58)
Colour = tuple[float, float, float]


@dataclass(frozen=True, slots=True)
class Face:
    """A flat convex polygon.

    Attributes:
        corners: Corners [m], world frame, shape (k, 3).
        colour: Red, green, blue, each in [0, 1].
        opacity: Opacity in [0, 1].
    """

    corners: Array
    colour: Colour
    opacity: float = 1.0


def robot_faces(position: Array, orientation_wxyz: Array) -> list[Face]:
    """Build the robot: base, top rod, arm and four rotor discs.

    Args:
        position: Position of the base [m], world frame, shape (3,).
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
        # The model has no struts, but without them the rotor discs would float.
        strut = np.array([abs(x) * body.ROTOR_ARM / 2 + 0.006, abs(y) * body.ROTOR_ARM / 2 + 0.006])
        faces += _box(hub * (0.5, 0.5, 1.0), np.array([*strut, 0.006]), ROD_COLOUR)
        disc = hub + body.ROTOR_RADIUS * _circle(28)
        faces.append(Face(disc, ROTOR_COLOUR, 0.35))
    points = body.Spheres(np.concatenate([face.corners for face in faces]), np.zeros(0))
    placed = body.place_points(points, position[None], orientation_wxyz[None])[0]
    splits = np.cumsum([len(face.corners) for face in faces])[:-1]
    return [
        Face(corners, face.colour, face.opacity)
        for corners, face in zip(np.split(placed, splits), faces, strict=True)
    ]


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


def is_inside_pipe(face: Face, other: Pipe) -> bool:
    """Tell whether a face cut through a pipe's wall lies inside another pipe that meets the pipe.

    Such a face is not drawn: sorted by depth, it would appear between faces of the other pipe.
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
    """Build an upright cylinder with flat sides and a lid."""
    ring = _circle(12) * half
    low, high = centre + ring - (0, 0, half[2]), centre + ring + (0, 0, half[2])
    sides = [
        Face(np.array([low[i - 1], low[i], high[i], high[i - 1]]), colour) for i in range(len(ring))
    ]
    return [*sides, Face(high, colour)]


def _circle(count: int) -> Array:
    angle = np.arange(count) * (2 * np.pi / count)
    return np.stack([np.cos(angle), np.sin(angle), np.zeros(count)], axis=1)


ALT = "Six line drawings of the robot along its path, with the pipes cut open, up to the board."
CAPTION = (
    "Snapshots. The robot at six instants, evenly spaced by distance flown (in a hover, by time) "
    "until the contact or the end. Pose and scale are true, pipes are cut open towards the reader, "
    "floor tiles are 0.5 m wide. The line is the path flown."
)
COUNT = 6
"""Number of panels in the figure [1]."""
MOVING = 0.05
"""Smallest distance in one second that defines a direction of flight [m]; a robot that moves less
counts as hovering."""
REACH = 1.0
"""Distance that a panel shows on either side of the robot [m]."""
ELEVATION, AZIMUTH = np.radians(28.0), np.radians(118.0)
"""Direction from the robot to the eye [rad]: angle above the horizon, and angle from the heading.
The eye is behind the robot, on its right."""


@dataclass(frozen=True, slots=True)
class Eye:
    """A parallel projection, as seen from an infinite distance.

    Attributes:
        right: Unit vector to the right of the picture, shape (3,).
        up: Unit vector to the top of the picture, shape (3,).
        towards: Unit vector towards the eye, shape (3,).
    """

    right: Array
    up: Array
    towards: Array


def caption(subject: Subject) -> str:
    """Write the caption."""
    return CAPTION


def draw(subject: Subject) -> Figure:
    """Draw the panels."""
    figure = new_figure(PAGE, 4.1)
    panels = figure.subplots(2, COUNT // 2).flat
    rows = _instants(subject)
    for letter, axes in zip("abcdef", panels, strict=True):
        axes.set_axis_off()
        axes.set_aspect("equal")
        axes.set_xlim(-REACH, REACH)
        axes.set_ylim(-REACH * 0.82, REACH * 0.72)
        if len(rows):
            _draw_panel(axes, subject, rows["abcdef".index(letter)], letter)
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
    wanted = measure[-1] * np.arange(1, COUNT + 1) / COUNT
    rows: Array = np.minimum(np.searchsorted(measure, wanted), len(stamps) - 1)
    return rows


def _draw_panel(axes: Axes, subject: Subject, row: int, letter: str) -> None:
    truth, scene = subject.flight.truth, subject.flight.scene
    position, orientation = truth["position"][row], truth["orientation_wxyz"][row]
    eye = _eye(_heading(subject, row))
    around = [
        face
        for pipe in scene.pipes
        for face in pipe_faces(pipe, eye.towards, position, REACH)
        if not any(is_inside_pipe(face, other) for other in scene.pipes if other is not pipe)
    ]
    around += board_faces(scene.board) if scene.board else []
    _draw_floor(axes, eye, position, scene.floor)
    _draw_faces(axes, eye, position, around, zorder=1)
    _draw_path(axes, eye, position, truth["position"][: row + 1])
    _draw_faces(axes, eye, position, robot_faces(position, orientation), zorder=3)
    _label(axes, subject, row, letter)


def _draw_path(axes: Axes, eye: Eye, position: Array, path: Array) -> None:
    """Draw the part of the path flown since the robot entered the picture."""
    far = np.flatnonzero(np.linalg.norm(path - position, axis=1) > 1.5 * REACH)
    seen = _project(eye, path[far[-1] if len(far) else 0 :] - position)
    axes.plot(seen[:, 0], seen[:, 1], color=BLUE, lw=1.0, zorder=2)


def _label(axes: Axes, subject: Subject, row: int, letter: str) -> None:
    time = float(subject.flight.seconds(subject.flight.truth["stamp_ns"][row]))
    text = f"({letter}) {time:.1f} s"
    inside = pipe_index(subject.flight.scene, subject.flight.truth["position"][row][None])[0]
    if inside >= 0:
        pipe = subject.flight.scene.pipes[inside].name.replace("_", " ")
        text += f", {pipe}, clearance {subject.flight.clearance[row]:.2f} m"
    axes.set_title(text, loc="left", fontsize=8.5)


def _heading(subject: Subject, row: int) -> float:
    """Compute the heading of the view [rad].

    The view looks along the pipe that contains the robot, else along the robot's path.
    """
    scene, positions = subject.flight.scene, subject.flight.truth["position"]
    position = positions[row]
    inside = pipe_index(scene, position[None])[0]
    if inside >= 0:
        x, y, _ = scene.pipes[inside].axis
    else:
        x, y, _ = position - positions[max(row - 100, 0)]
        if np.hypot(x, y) < MOVING:
            x, y = 1.0, 0.0
    return float(np.arctan2(y, x))


def _eye(heading: float) -> Eye:
    azimuth = heading - AZIMUTH
    towards = np.array(
        [
            np.cos(ELEVATION) * np.cos(azimuth),
            np.cos(ELEVATION) * np.sin(azimuth),
            np.sin(ELEVATION),
        ]
    )
    right = np.array([-np.sin(azimuth), np.cos(azimuth), 0.0])
    return Eye(right, np.cross(towards, right), towards)


def _project(eye: Eye, points: Array) -> Array:
    """Project points, shape (..., 3), to the picture, shape (..., 2)."""
    return np.stack([points @ eye.right, points @ eye.up], axis=-1)


def _draw_faces(axes: Axes, eye: Eye, origin: Array, faces: list[Face], zorder: int) -> None:
    """Draw faces from back to front, shaded by their angle to the light."""
    ordered = sorted(faces, key=lambda face: float((face.corners @ eye.towards).mean()))
    polygons, colours = [], []
    for face in ordered:
        polygons.append(_project(eye, face.corners - origin))
        a, b, c = face.corners[:3]
        normal = np.cross(b - a, c - b)
        length = float(np.linalg.norm(normal))
        light = 0.62 + 0.38 * abs(float(normal @ (eye.towards + eye.up))) / (length * np.sqrt(2))
        colours.append((*(light * np.array(face.colour)), face.opacity))
    axes.add_collection(
        PolyCollection(polygons, facecolors=colours, edgecolors=colours, lw=0.15, zorder=zorder)
    )


def _draw_floor(axes: Axes, eye: Eye, position: Array, height: float) -> None:
    """Draw the joints of the tiles around the robot."""
    x, y = (np.round(position[:2] * 2) / 2).tolist()
    offsets = np.arange(-3.0, 3.5, 0.5)
    lines = [np.array([[x + d, y - 3, height], [x + d, y + 3, height]]) for d in offsets]
    lines += [np.array([[x - 3, y + d, height], [x + 3, y + d, height]]) for d in offsets]
    seen = [_project(eye, line - position) for line in lines]
    axes.add_collection(LineCollection(seen, colors=LIGHT, lw=0.4, zorder=0))
