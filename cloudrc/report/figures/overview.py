"""Draw the overview: the scene with tubes cut open, the path, and the robot at some instants.

All bodies consist of flat convex polygons, which are drawn from back to front.
"""

from __future__ import annotations

from dataclasses import replace
from itertools import chain
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from cloudrc.geometry.scene import FLOOR
from cloudrc.geometry.shapes import Array, Surface, rotation
from cloudrc.geometry.tubes import cut_open
from cloudrc.metrics import Flight
from cloudrc.metrics.mission import first_touch
from cloudrc.report.figures.labels import free_label
from cloudrc.report.figures.projection import Polygons, View, glass, lighter, simplified, split
from cloudrc.report.figures.style import (
    BLACK,
    GREY,
    LIGHT,
    Subject,
    broken,
    distance_moved,
    new_figure,
    own_bodies,
    sampled,
)

ALT = "A drawing of the scene in perspective from above: obstacles, the path, and the robot."
CAPTION = (
    "Overview. The whole path, and the robot at up to six instants, evenly spaced by the distance "
    "moved until the contact or the end. Pose and scale are true."
)
ROBOTS = 6
"""Largest number of robots in the drawing."""
ELEVATION = np.radians(38.0)
"""Angle of the view above the horizontal plane [rad]."""
USUAL, MARGIN, SMALLEST, APART = 0.85, 0.6, 4.0, 0.7
"""For a robot of USUAL size: space around path and obstacles, smallest width of the part that is
drawn, and smallest distance between two of the robots [m]. For a smaller robot they are less."""
NEAR = np.array([1.0, 1.0, 2.2])
"""Distance from the path along x, y and z up to which obstacles are in the drawing [m]."""
FLATTEST, TALLEST = 0.3, 0.6
"""Limits of the drawing's ratio of height to width."""
ROUND = 0.6
"""Ratio of a path's width to its length above which the direction of view does not follow it."""
ASKEW = np.radians(20.0)
"""Angle from x to the picture's horizontal for such a path [rad]: bodies show two sides."""
TINY = 0.2
"""Size in print below which an inset enlarges the robot [in]."""
INSET, ENLARGED = 0.2, 0.7
"""Width of the inset, as a share of the drawing, and of the robot, as a share of the inset."""
PATH, CUT = (0.0, 0.45, 0.70, 1.0), (0.45, 0.48, 0.52, 1.0)
"""Colours of the path and of the wall of a cut tube: red, green, blue, opacity in [0, 1]."""
TUBE = (0.86, 0.88, 0.90, 1.0)
"""Colour of the inner face of a cut tube."""
PALE = 0.45
"""Share of white in the colours of the scene, so that robot and path stand out."""
DOT = 0.004
"""Width of the smallest details that are drawn [in]."""


class _Stage:
    """The part of the world that the overview of a flight shows, and the view of it."""

    def __init__(self, subject: Subject) -> None:
        flight, shapes = subject.flight, subject.shapes
        self.path, self.robot = flight.truth["position"], shapes.robot
        self.behind = flight.rows_behind_holes(flight.truth["stamp_ns"])
        self.planar = shapes.planar
        self.turns, self.scene = flight.truth["orientation_wxyz"], flight.scene
        self.obstacles = own_bodies(subject)
        self.scale = min(shapes.size / USUAL, 1.0) if shapes.robot else 1.0
        points = np.concatenate([self._places(), self._near()])
        self.view = View(_horizontal(self._places(), self._front()), ELEVATION)
        self.shown = self._project(points)
        self.middle, self.size = self._frame()
        self.rows = self._instants(flight)
        self.tile = 1.0 if self.size[0] > 3.0 else 0.1
        per_metre = subject.look.width / float(self.size[0])
        self.dot = DOT / per_metre
        self.is_tiny = bool(self.rows) and 0.0 < shapes.size * per_metre < TINY

    def _places(self) -> Array:
        """Return the places that must be in the drawing [m], shape (n, 3)."""
        tubes = [
            (np.array(each.centre), np.array(each.axis) * each.length) for each in self.scene.tubes
        ]
        ends = [centre + side * along for centre, along in tubes for side in (-0.5, 0.5)]
        found: list[Any] = [[self.scene.spawn], self.path, np.reshape(ends, (-1, 3))]
        if self.has_shadow:
            found.append(self.shadow)
        return np.concatenate(found)

    @property
    def has_shadow(self) -> bool:
        """Whether the path's shadow on the floor shows its height; tubes would hide it."""
        return not (self.planar or self.scene.tubes)

    @property
    def shadow(self) -> Array:
        """The path, moved down to the floor [m], shape (n, 3)."""
        return np.asarray(self.path * (1, 1, 0) + (0, 0, self.scene.floor))

    def _near(self) -> Array:
        """Return corners of the obstacles near the path, up to `NEAR` from it [m], shape (n, 3)."""
        around = self._places()
        low, high = around.min(axis=0) - NEAR, around.max(axis=0) + NEAR
        found = [np.zeros((0, 3))]
        for surface in self.obstacles:
            corners = surface.corners
            if (corners.min(axis=0) <= high).all() and (corners.max(axis=0) >= low).all():
                found.append(np.clip(corners, low, high))
        return np.concatenate(found)

    def _front(self) -> Array | None:
        """Return the direction from the first tube to the spawn, from where tubes are seen."""
        tubes = self.scene.tubes
        return np.subtract(self.scene.spawn, tubes[0].centre) if tubes else None

    def _project(self, points: Array) -> Array:
        """Return `points` [m], shape (n, 3), and all tubes in the picture [m], shape (m, 2)."""
        cut = [cut_open(tube, self.view.towards, TUBE, CUT) for tube in self.scene.tubes]
        walls = [surface.corners for surface in chain(*cut)]
        return self.view.project(np.concatenate([points, *walls]))

    def _frame(self) -> tuple[Array, Array]:
        """Return middle and size [m] of the part of the picture that is drawn, shape (2,)."""
        middle = (self.shown.max(axis=0) + self.shown.min(axis=0)) / 2
        size = np.ptp(self.shown, axis=0) + 2 * MARGIN * self.scale
        least = SMALLEST * self.scale
        size = np.maximum(size, (least, least * FLATTEST))
        ratio = float(np.clip(size[1] / size[0], FLATTEST, TALLEST))
        return middle, np.maximum(size, (size[1] / ratio, size[0] * ratio))

    def _instants(self, flight: Flight) -> list[int]:
        """Choose the rows of the true states at which to draw the robot.

        The rows are at equal distances along the path, up to the first touch. Leave out a row where
        the robot would be too near to a robot that is already drawn.
        """
        stamps, touch = flight.truth["stamp_ns"], first_touch(flight)
        if touch is not None:
            stamps = stamps[stamps <= touch["stamp_ns"]]
        if not len(stamps):
            return []
        way = distance_moved(self.path[: len(stamps)])
        wanted = way[-1] * np.arange(ROBOTS) / (ROBOTS - 1)
        apart = max(APART * self.scale, APART / 10 * float(self.size[0]) / SMALLEST)
        rows: list[int] = []
        for row in np.minimum(np.searchsorted(way, wanted), len(stamps) - 1).tolist():
            position = self.view.project(self.path[[row, *rows]])
            if not rows or np.linalg.norm(position[1:] - position[0], axis=1).min() > apart:
                rows.append(row)
        return rows

    def robot_at(self, row: int) -> list[Surface]:
        """Return the robot at a row of the true states."""
        axes = rotation(self.turns[row])
        small = [simplified(surface, self.dot) for surface in self.robot]
        return [surface.placed(self.path[row], axes) for surface in small]

    def surroundings(self, robots: Array) -> list[Polygons]:
        """Return the scene; what hides path or `robots` [m], shape (n, 3), is translucent."""
        found = []
        shown = np.concatenate([self.path[::10], robots])
        for surface in self.obstacles:
            surface = replace(surface, rgba=lighter(surface.rgba, PALE))
            if surface.body != FLOOR and len(shown) and self.view.hides(surface, shown):
                found += glass(self.view, surface)
            else:
                found += self.view.polygons([split(simplified(surface, self.dot))])
        for tube in self.scene.tubes:
            found += self.view.polygons(cut_open(tube, self.view.towards, TUBE, CUT))
        return found


def _horizontal(points: Array, front: Array | None) -> Array:
    """Return the unit vector that is from left to right in the drawing, shape (3,).

    It is along the longer side of `points` [m], shape (n, 3), or near x if no side is longer. The
    viewer is in the direction `front` [m], shape (3,); None: x increases to the right.
    """
    level = points[:, :2] - points[:, :2].mean(axis=0)
    _, sizes, axes = np.linalg.svd(level, full_matrices=False)
    x, y = axes[0]
    if front is None and sizes[-1] > ROUND * sizes[0]:
        x, y = np.cos(ASKEW), np.sin(ASKEW)
    right = np.array([x, y, 0.0])
    is_behind = (x, y) < (0.0, 0.0) if front is None else front[:2] @ (y, -x) < 0
    return -right if is_behind else right


def caption(subject: Subject) -> str:
    """Return the caption of the figure."""
    stage = _Stage(subject)
    text = CAPTION
    if subject.flight.scene.tubes:
        text += " Tubes are cut open towards the reader."
    if stage.obstacles:
        text += " Obstacles in front of the path are translucent."
    if stage.is_tiny:
        text += " Circles mark the robot, which the inset enlarges."
    return f"{text} Floor tiles are {stage.tile:g} m wide."


def draw(subject: Subject) -> Figure:
    """Draw the overview of the flight in one panel."""
    stage, flight = _Stage(subject), subject.flight
    view, path = stage.view, stage.path
    width = subject.look.width
    figure = new_figure(width * float(stage.size[1] / stage.size[0]), width)
    axes = figure.subplots()
    axes.set_axis_off()
    axes.set_aspect("equal")
    (left, low), (right, high) = (stage.middle + side * stage.size / 2 for side in (-1, 1))
    axes.set(xlim=(left, right), ylim=(low, high))
    _draw_floor(axes, stage)
    robots = [stage.robot_at(row) for row in stage.rows]
    corners = [np.concatenate([each.corners for each in robot]) for robot in robots if robot]
    parts = stage.surroundings(np.concatenate([np.zeros((0, 3)), *corners]))
    parts += view.polygons(chain(*robots))
    ends, is_line = sampled(len(path), stage.behind)
    steps = path[ends]
    if len(steps) > 1:
        lines = np.stack([steps[:-1], steps[1:]], axis=1)[is_line]
        size = subject.shapes.size
        distance = np.linalg.norm(lines[:, None, 0] - path[stage.rows], axis=2).min(axis=1)
        for near, behind in ((distance < size / 2, size), (distance >= size / 2, 0.0)):
            parts.append(Polygons(lines[near], np.tile(PATH, (near.sum(), 1)), behind=behind))
    view.draw(axes, parts)
    axes.plot(*view.project(steps).T, lw=0)  # invisible, but labels avoid it
    for points in corners:
        axes.plot(*view.project(points).T, lw=0)
    _label_times(axes, stage, flight)
    if stage.is_tiny:
        _draw_inset(axes, stage, subject)
    return figure


def _label_times(axes: Axes, stage: _Stage, flight: Flight) -> None:
    """Write the time at each place of the robot that is drawn; mark a tiny robot by a circle."""
    for row in stage.rows:
        place = stage.view.project(stage.path[row])
        if stage.is_tiny:
            axes.plot(*place, "o", ms=9, mfc="none", mec=GREY, mew=0.6, zorder=6)
        free_label(axes, f"{flight.seconds(flight.truth['stamp_ns'][row]):.1f} s", place)


def _draw_floor(axes: Axes, stage: _Stage) -> None:
    """Draw floor tiles, and above a floor without tubes the path's shadow."""
    view, height = stage.view, stage.scene.floor
    reach = float(stage.size.max()) / np.sin(ELEVATION)
    x, y = (view.lift(stage.middle[None], 0.0)[0] + _down(view, stage, height))[:2]
    start = np.floor(np.array([x, y]) / stage.tile - reach / stage.tile) * stage.tile
    count = int(2 * reach / stage.tile) + 2
    ends = start + count * stage.tile
    for n in range(count + 1):
        at = start + n * stage.tile
        for line in (
            [(at[0], start[1], height), (at[0], ends[1], height)],
            [(start[0], at[1], height), (ends[0], at[1], height)],
        ):
            axes.plot(*view.project(np.array(line)).T, color=LIGHT, lw=0.4, zorder=0)
    if stage.has_shadow:
        shadow = broken(view.project(stage.shadow), stage.behind)
        axes.plot(*shadow.T, color=GREY, lw=0.7, alpha=0.5, zorder=0)


def _down(view: View, stage: _Stage, height: float) -> Array:
    """Return the way from the middle of the picture along the view to the floor [m], shape (3,)."""
    at = view.lift(stage.middle[None], 0.0)[0]
    return np.asarray((height - at[2]) / view.towards[2] * view.towards)


def _draw_inset(axes: Axes, stage: _Stage, subject: Subject) -> None:
    """Enlarge the robot, as it is at rest, in the corner with the least behind it."""
    ratio = float(stage.size[1] / stage.size[0])
    height = INSET / ratio
    shares = (stage.shown - stage.middle) / stage.size + 0.5

    def covered(place: tuple[float, float]) -> int:
        inside = (shares >= place) & (shares <= np.add(place, (INSET, height)))
        return int(inside.all(axis=1).sum())

    corners = [(x, y) for y in (1.0 - height, 0.0) for x in (1.0 - INSET, 0.0)]
    left, low = min(corners, key=covered)
    inset = axes.inset_axes((left, low, INSET, height))
    inset.set(xticks=[], yticks=[], aspect="equal")
    inset.spines[:].set(visible=True, color=GREY, linewidth=0.6)
    inset.grid(visible=False)
    stage.view.draw(inset, stage.view.polygons(stage.robot))
    points = stage.view.project(np.concatenate([each.corners for each in stage.robot]))
    middle = (points.max(axis=0) + points.min(axis=0)) / 2
    half = float(np.ptp(points, axis=0).max()) / ENLARGED / 2
    inset.set_xlim(middle[0] - half, middle[0] + half)
    inset.set_ylim(middle[1] - 1.2 * half, middle[1] + 0.8 * half)
    bar = _round_length(half)
    low = middle[1] - 1.0 * half
    inset.plot([middle[0] - bar / 2, middle[0] + bar / 2], [low, low], color=BLACK, lw=1.5)
    inset.annotate(
        f"{bar * 100:g} cm",
        (middle[0], low),
        (0, 2),
        textcoords="offset points",
        ha="center",
        va="bottom",
        fontsize="small",
    )


def _round_length(most: float) -> float:
    """Return the largest of 1, 2 and 5 times a power of ten up to `most` [m]."""
    power = 10.0 ** np.floor(np.log10(most))
    return float(max(each for each in (power, 2 * power, 5 * power) if each <= most))
