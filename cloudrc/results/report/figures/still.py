# SPDX-License-Identifier: Apache-2.0

"""Draw a still picture of a flight in its scene, for readers whose browser draws no 3-D."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import matplotlib
import numpy as np
from matplotlib.collections import LineCollection, PolyCollection
from matplotlib.colors import to_rgba
from matplotlib.figure import Figure

from cloudrc.physics.geometry.clearance import CLEARANCE_SHOWN, rotations
from cloudrc.physics.geometry.shapes import Surface
from cloudrc.physics.geometry.tubes import rims, wall
from cloudrc.results.metrics.flight import Array, Flight
from cloudrc.results.report.figures.flight import MARGIN, draw_waypoints
from cloudrc.results.report.figures.style import BLUE, GREY, LIGHT, Subject

AZIMUTH, ELEVATION = np.radians(-60.0), np.radians(25.0)
"""Direction of the viewer, seen from the scene [rad]."""
RIGHT = np.array([-np.sin(AZIMUTH), np.cos(AZIMUTH), 0.0])
NEAR = np.array([RIGHT[1], -RIGHT[0], 0.0])
TO_VIEWER = np.cos(ELEVATION) * NEAR + np.array([0.0, 0.0, np.sin(ELEVATION)])
UP = np.cross(TO_VIEWER, RIGHT)
"""Unit vectors in the world frame [1]. The axes of the picture are RIGHT and UP; it has no
perspective. Of two points at one place of the picture, the one farther along NEAR is in front."""
TO_LIGHT = np.array([0.2, -0.5, 0.84])
"""Unit vector from the scene to the light [1]."""
TUBE = (0.77, 0.81, 0.85, 1.0)
"""Colour of a tube: red, green, blue, opacity in [0, 1]."""
HEIGHT, LINE = 3.6, 0.003
"""Height of the picture [in]; half the width of the path, as a share of its extent [1]."""
STEP = 0.01
"""Least distance of two drawn points of the path [m]."""
ALT = "The flown path among waypoints and obstacles, seen from above and from the side."
CAPTION = (
    "A still picture of the flight. Circles: waypoints. The colour of the path is its clearance; "
    "the thin line is its shadow on the floor, whose lines are 1 m apart."
)

Triangles = tuple[Array, Array]
"""Corners in the world frame [m], shape (n, 3, 3), and colours, shape (n, 4)."""


def draw(subject: Subject) -> Figure:
    """Draw scene, path and waypoints, and the robot at the end of its path, which has a point."""
    flight, tubes = subject.flight, subject.flight.scene.tubes
    figure = Figure(figsize=(subject.look.width, HEIGHT))
    axes: Any = figure.add_axes((0.0, 0.0, 1.0, 1.0), aspect="equal", adjustable="datalim")
    axes.set_axis_off()
    # The wall behind a tube's axis is behind the path in the tube.
    walls = [part for tube in tubes for part in (_far_half(wall(tube, TUBE)), *rims(tube, TUBE))]
    names = {tube.name for tube in tubes}
    parts = [_shaded(each) for each in subject.shapes.scene if each.body not in names]
    path, floor = flight.truth["position"], flight.scene.floor
    pose = path[-1], rotations(flight.truth["orientation_wxyz"][-1:])[0]
    parts += [_ribbon(flight), *(_shaded(each.placed(*pose)) for each in subject.shapes.robot)]
    axes.add_collection(LineCollection(_grid(path, floor), colors=LIGHT, lw=0.6, zorder=1))
    shadow = np.column_stack([path[:, :2], np.full(len(path), floor)])
    axes.plot(*_project(shadow).T, color=GREY, lw=0.6, zorder=1.5)
    axes.update_datalim(_project(path))
    for zorder, layer in enumerate((list(map(_shaded, walls)), parts), start=2):
        if layer:
            axes.add_collection(_in_order(layer, zorder), autolim=False)
    draw_waypoints(axes, [_project(each.position_m) for each in flight.mission.waypoints])
    axes.margins(MARGIN)
    return figure


def _project(points: Any) -> Any:
    """Return the places in the picture of points in the world frame [m], shape (..., 3)."""
    return np.asarray(points) @ np.stack([RIGHT, UP], axis=1)


def _in_order(layer: Sequence[Triangles], zorder: int) -> PolyCollection:
    """Return triangles as one collection, the farthest ones first."""
    corners, colours = (np.concatenate(each) for each in zip(*layer, strict=True))
    order = np.argsort(corners.mean(axis=1) @ NEAR, kind="stable")
    drawn = PolyCollection(_project(corners[order]), facecolors=colours[order], zorder=zorder)
    drawn.set(lw=0, antialiased=False)  # else the edges of the triangles show
    return drawn


def _grid(path: Array, floor: float) -> Any:
    """Return lines at whole metres around the path, at the height `floor` [m], shape (n, 2, 2)."""
    low, high = np.floor(path.min(axis=0) - 0.5), np.ceil(path.max(axis=0) + 0.5)
    along_y = [((x, low[1], floor), (x, high[1], floor)) for x in np.arange(low[0], high[0] + 1)]
    along_x = [((low[0], y, floor), (high[0], y, floor)) for y in np.arange(low[1], high[1] + 1)]
    return _project([*along_y, *along_x])


def _shaded(surface: Surface) -> Triangles:
    """Return the visible triangles of a surface, darker where they turn away from the light."""
    corners = surface.corners[surface.triangles]
    normals = _normals(corners)
    if surface.convex:
        is_front = normals @ TO_VIEWER > 0
        corners, normals = corners[is_front], normals[is_front]
    colours = np.tile(surface.rgba, (len(corners), 1))
    colours[:, :3] *= 0.55 + 0.45 * np.abs(normals @ TO_LIGHT)[:, None]
    return corners, colours


def _far_half(tube: Surface) -> Surface:
    """Return the part of a tube that is behind its axis."""
    is_far = _normals(tube.corners[tube.triangles]) @ TO_VIEWER < 0
    return replace(tube, triangles=tube.triangles[is_far])


def _normals(corners: Array) -> Array:
    """Return unit vectors across triangles, shape (n, 3); `corners` have the shape (n, 3, 3)."""
    across = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    return np.asarray(across / np.maximum(np.linalg.norm(across, axis=1, keepdims=True), 1e-12))


def _ribbon(flight: Flight) -> Triangles:
    """Return the path as a ribbon that faces the viewer, in the colours of its clearance."""
    path = flight.truth["position"]
    moved = np.cumsum(np.linalg.norm(np.diff(path, axis=0, prepend=path[:1]), axis=1))
    rows = np.searchsorted(moved, np.arange(0.0, moved[-1], STEP))
    rows = np.unique([0, *rows, len(path) - 1])
    begins, ends, near = path[rows[:-1]], path[rows[1:]], flight.clearance
    side = np.cross(ends - begins, TO_VIEWER)
    side /= np.maximum(np.linalg.norm(side, axis=1, keepdims=True), 1e-12)
    side *= LINE * np.ptp(path, axis=0).max()
    one = np.stack([begins - side, begins + side, ends + side], axis=1)
    other = np.stack([begins - side, ends + side, ends - side], axis=1)
    colours = np.tile(to_rgba(BLUE), (len(begins), 1))
    if len(near):
        share = np.clip(near[rows[:-1]] / CLEARANCE_SHOWN, 0.0, 1.0)
        colours = matplotlib.colormaps["viridis"](share)
    return np.concatenate([one, other]), np.tile(colours, (2, 1))
