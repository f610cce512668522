"""Figure of snapshots: the robot along its way, in the pipes cut open, drawn from the geometry."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection, PolyCollection
from matplotlib.figure import Figure

from cloudrc.geometry.clearance import pipe_index
from cloudrc.metrics.flight import Array
from cloudrc.metrics.mission import first_touch
from cloudrc.report.figures.solids import Face, board_faces, is_swallowed, pipe_faces, robot_faces
from cloudrc.report.figures.style import BLUE, LIGHT, PAGE, new_figure
from cloudrc.report.figures.subject import Subject

ALT = "Six line drawings of the robot along its way, in the pipes cut open, up to the board."
CAPTION = (
    "Along the way. The robot at six instants, evenly spaced over the distance flown (in a hover "
    "over time) up to the contact or the end; true pose and scale, pipes cut open towards the "
    "reader, floor tiles 0.5 m wide. The line is the path flown."
)
COUNT = 6
MOVING = 0.05
"""Less way than that in a second [m] is a hover, which has no direction."""
REACH = 1.0
"""What a panel shows to either side of the robot [m]."""
ELEVATION, AZIMUTH = np.radians(28.0), np.radians(118.0)
"""Of the eye: above the horizon, and behind the robot to its right: what lies ahead is seen."""


@dataclass(frozen=True, slots=True)
class Eye:
    """A direction to look from, infinitely far: parallel lines stay parallel.

    Attributes:
        right: Unit vector to the right in the picture, shape (3,).
        up: Unit vector upwards in it, shape (3,).
        towards: Unit vector towards the eye, shape (3,).
    """

    right: Array
    up: Array
    towards: Array


def caption(subject: Subject) -> str:
    """Say what is seen."""
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
    """Choose rows of the true states: evenly over the distance, or over time in a hover."""
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
        if not any(is_swallowed(face, other) for other in scene.pipes if other is not pipe)
    ]
    around += board_faces(scene.board) if scene.board else []
    _draw_floor(axes, eye, position, scene.floor)
    _draw_faces(axes, eye, position, around, zorder=1)
    _draw_path(axes, eye, position, truth["position"][: row + 1])
    _draw_faces(axes, eye, position, robot_faces(position, orientation), zorder=3)
    _label(axes, subject, row, letter)


def _draw_path(axes: Axes, eye: Eye, position: Array, path: Array) -> None:
    """Draw the last stretch flown: up to the instant at which the robot came into the picture."""
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
    """Direction to draw along [rad]: the axis of the pipe around the robot, else the way flown."""
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
    """Flatten points, shape (..., 3), to the picture, shape (..., 2)."""
    return np.stack([points @ eye.right, points @ eye.up], axis=-1)


def _draw_faces(axes: Axes, eye: Eye, origin: Array, faces: list[Face], zorder: int) -> None:
    """Draw from the back to the front, each face shaded by how it is turned to the light."""
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
