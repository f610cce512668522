"""Draw the overview: the scene with pipes cut open, the path, and the robot at some instants.

All bodies consist of small convex polygons, which are drawn from back to front.
"""

from __future__ import annotations

from dataclasses import replace
from itertools import chain, pairwise

import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import PolyCollection
from matplotlib.figure import Figure

from cloudrc.geometry import clearance as body
from cloudrc.geometry.scene import Pipe
from cloudrc.metrics.flight import Array
from cloudrc.metrics.mission import first_touch
from cloudrc.report.figures.labels import free_label
from cloudrc.report.figures.style import LIGHT, Subject, new_figure
from cloudrc.report.solids import DRAWN, PATH, PIPE, Face, board_faces, bore, robot_faces, strip

ALT = (
    "A drawing of the scene in perspective from above: pipes cut open, board, path, and the robot."
)
CAPTION = (
    "Overview. The whole path, and the robot at up to six instants, evenly spaced by distance "
    "flown until the contact or the end. Pose and scale are true, pipes are cut open "
    "towards the reader, floor tiles are 1 m wide."
)
MARKED = "A marker stands for the robot; obstacles other than pipes and board are not drawn."
"""Further sentence of the caption for a robot other than the Pelican."""
ROBOTS, APART = 6, 0.6
"""Largest number of robots in the drawing, and the smallest distance between two of them [m]."""
ELEVATION = np.radians(38.0)
"""Angle of the view above the horizontal plane [rad]."""
MARGIN, SMALLEST = 0.6, 4.0
"""Space around path and obstacles, and smallest width of the part that is drawn [m]."""
FLATTEST, TALLEST = 0.3, 0.6
"""Limits of the drawing's ratio of height to width."""
WALL_COLOUR = (0.45, 0.48, 0.52)


def caption(subject: Subject) -> str:
    """Return the caption of the figure."""
    return CAPTION + (f" {MARKED}" if subject.robot != DRAWN else "")


def _robot(robot: str, position: Array, orientation_wxyz: Array) -> list[Face]:
    faces = robot_faces(robot)
    points = body.Spheres(np.concatenate([face.corners for face in faces]), np.zeros(0))
    placed = body.place_points(points, position[None], orientation_wxyz[None])[0]
    corners = np.split(placed, np.cumsum([len(face.corners) for face in faces])[:-1])
    return [face._replace(corners=each) for face, each in zip(faces, corners, strict=True)]


def _pipe(pipe: Pipe, view: _View) -> list[Face]:
    """Build the half of a pipe that is farther from the viewer."""
    stations = 1 + max(1, round(pipe.length / 0.25))
    inner = bore(pipe, view.towards, np.pi / 2, 17, stations)
    outer = bore(replace(pipe, inner=pipe.outer), view.towards, np.pi / 2, 17, stations)
    faces = [face for pair in pairwise(inner) for face in strip(*pair, PIPE)]
    for edge in (0, -1):
        faces += strip(inner[:, edge], outer[:, edge], WALL_COLOUR)
    return faces


class _View:
    """A parallel projection of the scene, with the scene's longer side as the horizontal."""

    def __init__(self, points: Array, front: Array) -> None:
        """Choose the direction of view for `points` [m], world frame, shape (n, 3).

        The vector `front`, world frame, shape (3,), points from the scene towards the viewer.
        """
        level = points[:, :2] - points[:, :2].mean(axis=0)
        x, y = np.linalg.svd(level, full_matrices=False)[2][0]
        if front[:2] @ (y, -x) < 0:
            x, y = -x, -y
        right = np.array([x, y, 0.0])
        self.towards = np.array([y * np.cos(ELEVATION), -x * np.cos(ELEVATION), np.sin(ELEVATION)])
        self._sides = np.stack([right, np.cross(self.towards, right)], axis=1)

    def project(self, points: Array) -> Array:
        """Project points [m], world frame, shape (..., 3), to the image [m], shape (..., 2)."""
        return np.asarray(points @ self._sides)

    def draw_faces(self, axes: Axes, faces: list[Face]) -> None:
        """Draw faces from back to front; a face is brightest if light meets it at a right angle."""
        faces = sorted(faces, key=lambda face: float((face.corners @ self.towards).mean()))
        light = (self.towards + self._sides[:, 1]) / np.sqrt(2)
        colours = []
        for face in faces:
            shade = 1.0
            if len(face.corners) > 2:
                a, b, c = face.corners[:3]
                normal = np.cross(b - a, c - b)
                shade = 0.62 + 0.38 * abs(float(normal @ light)) / float(np.linalg.norm(normal))
            colours.append((*(shade * np.array(face.colour)), face.opacity))
        polygons = [self.project(face.corners) for face in faces]
        widths = [0.15 if len(face.corners) > 2 else 1.2 for face in faces]
        drawn = PolyCollection(
            polygons, facecolors=colours, edgecolors=colours, linewidths=widths, zorder=1
        )
        axes.add_collection(drawn)


def draw(subject: Subject) -> Figure:
    """Draw the overview of the flight in one panel."""
    truth, scene = subject.flight.truth, subject.flight.scene
    rows, path = _instants(subject), truth["position"]
    # The ends of the pipes' axes are enough to choose the view. The start is before the first pipe.
    axes_ends = [(np.array(pipe.centre), np.array(pipe.axis) * pipe.length) for pipe in scene.pipes]
    ends = [centre + side * along for centre, along in axes_ends for side in (-0.5, 0.5)]
    points = np.concatenate([[scene.spawn], path, np.reshape(ends, (-1, 3))])
    view = _View(points, scene.spawn - (axes_ends[0][0] if ends else np.array(scene.spawn)))
    robots = [_robot(subject.robot, path[row], truth["orientation_wxyz"][row]) for row in rows]
    faces = [face for pipe in scene.pipes for face in _pipe(pipe, view)]
    faces += [*chain(*robots), *(board_faces(scene.board) if scene.board else [])]
    shown = view.project(np.concatenate([points, *[face.corners for face in faces]]))
    steps = path[np.append(np.arange(0, len(path) - 1, 5), len(path) - 1)] if len(path) else path
    faces += [Face(np.stack(pair), PATH) for pair in pairwise(steps)]
    middle, size = (shown.max(axis=0) + shown.min(axis=0)) / 2, np.ptp(shown, axis=0) + 2 * MARGIN
    size = np.maximum(size, (SMALLEST, SMALLEST * FLATTEST))
    ratio = float(np.clip(size[1] / size[0], FLATTEST, TALLEST))
    size = np.maximum(size, (size[1] / ratio, size[0] * ratio))
    figure = new_figure(subject.look.width * ratio, subject.look.width)
    axes = figure.subplots()
    axes.set_axis_off()
    axes.set_aspect("equal")
    axes.set_xlim(middle[0] - size[0] / 2, middle[0] + size[0] / 2)
    axes.set_ylim(middle[1] - size[1] / 2, middle[1] + size[1] / 2)
    _draw_floor(axes, view, points, scene.floor)
    view.draw_faces(axes, faces)
    axes.plot(*view.project(steps).T, lw=0)  # invisible, but labels avoid it
    for row, robot in zip(rows, robots, strict=True):
        axes.plot(*view.project(np.concatenate([face.corners for face in robot])).T, lw=0)
        time = subject.flight.seconds(truth["stamp_ns"][row])
        free_label(axes, f"{time:.1f} s", view.project(path[row]))
    return figure


def _draw_floor(axes: Axes, view: _View, points: Array, height: float) -> None:
    """Draw floor tiles, 1 m wide, below `points` and around them; `height` is z [m]."""
    (x0, y0), (x1, y1) = np.floor(points.min(0)[:2]) - 4, np.ceil(points.max(0)[:2]) + 4
    lines = [[(x, y0, height), (x, y1, height)] for x in np.arange(x0, x1 + 1)]
    lines += [[(x0, y, height), (x1, y, height)] for y in np.arange(y0, y1 + 1)]
    for line in lines:
        axes.plot(*view.project(np.array(line)).T, color=LIGHT, lw=0.4, zorder=0)


def _instants(subject: Subject) -> list[int]:
    """Choose the rows of the true states at which to draw the robot.

    The rows are at equal distances along the path, up to the first touch of the board. Leave out a
    row where the robot would be less than APART from a robot that is already drawn.
    """
    truth, touch = subject.flight.truth, first_touch(subject.flight)
    stamps = truth["stamp_ns"]
    if touch is not None:
        stamps = stamps[stamps <= touch["stamp_ns"]]
    if not len(stamps):
        return []
    steps = np.linalg.norm(np.diff(truth["position"][: len(stamps)], axis=0), axis=1)
    way = np.concatenate([[0.0], np.cumsum(steps)])
    wanted = way[-1] * np.arange(ROBOTS) / (ROBOTS - 1)
    rows: list[int] = []
    for row in np.minimum(np.searchsorted(way, wanted), len(stamps) - 1).tolist():
        position = truth["position"][[row, *rows]]
        if not rows or np.linalg.norm(position[1:] - position[0], axis=1).min() > APART:
            rows.append(row)
    return rows
