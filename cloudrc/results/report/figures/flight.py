# SPDX-License-Identifier: Apache-2.0

"""Draw the figure of the flight: the path from above and from the side, and its clearance.

A robot that stays on the ground has no panel from the side.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.collections import PolyCollection
from matplotlib.figure import Figure

from cloudrc.physics.geometry.clearance import CLEARANCE_SHOWN
from cloudrc.physics.geometry.tubes import wall
from cloudrc.results.metrics.flight import Array
from cloudrc.results.report.figures.style import (
    BLACK,
    GREY,
    LIGHT,
    NARROW,
    Subject,
    new_figure,
    panel,
)

CEILING = 2 * CLEARANCE_SHOWN
"""Upper end of the clearance axis [m]."""
NO_COLOUR = (0.0, 0.0, 0.0, 0.0)
MARGIN = 0.15
"""Room around the path in a view, as a share of its extent [1]."""
ALT = "The path from above and from the side, with obstacles, and its clearance."
CAPTION = (
    "Flight. Circles: waypoints. Grey: obstacles; what the mission touches is darker. The colour "
    "is the clearance, the distance from the robot to the nearest obstacle, if it is known; its "
    f"axis ends at {CEILING:.1f} m."
)
ABOVE, SIDE, CLEARANCE = "path from above", "path from the side", "clearance"
"""Titles of the panels."""


def draw(subject: Subject) -> Figure:
    """Draw the path from above, from the side, and its clearance over the distance moved."""
    width, path = subject.look.width, subject.flight.truth["position"]
    right = [] if subject.shapes.planar else [SIDE]
    right += [CLEARANCE] if len(subject.flight.clearance) else []
    if width < NARROW:
        figure = new_figure(2.4 + 1.6 * len(right), width)
        axes = figure.subplot_mosaic([[title] for title in (ABOVE, *right)])
    else:
        figure = new_figure(3.5, width)
        axes = figure.subplot_mosaic([[ABOVE, title] for title in right] or [[ABOVE]])
    for letter, (title, each) in zip("abc", axes.items(), strict=False):
        panel(each, letter, title)
    coloured = _draw_view(axes[ABOVE], subject, (0, 1))
    axes[ABOVE].set_aspect("equal", adjustable="datalim")
    if side := axes.get(SIDE):
        extent = np.ptp(path, axis=0) if len(path) else np.zeros(3)
        _draw_view(side, subject, (int(extent[1] > extent[0]), 2))
        side.axhline(subject.flight.scene.floor, color=BLACK, lw=0.8)
    if margin := axes.get(CLEARANCE):
        _draw_clearance(margin, subject)
    if coloured is not None:
        below = [axes[title] for title in right]
        figure.colorbar(coloured, ax=below, extend="max", label="clearance (m)", pad=0.01)
    return figure


def _draw_view(axes: Axes, subject: Subject, sides: tuple[int, int]) -> ScalarMappable | None:
    """Draw path, waypoints and obstacles over two axes of the world, 0 to 2; return the path."""
    points = [waypoint.position_m for waypoint in subject.flight.mission.waypoints]
    draw_waypoints(axes, [[point[side] for side in sides] for point in points])
    _draw_obstacles(axes, subject, sides)
    path = _draw_path(axes, subject, subject.flight.truth["position"][:, sides])
    axes.margins(MARGIN)
    axes.set_xlabel(f"${'xyz'[sides[0]]}$ (m)")
    axes.set_ylabel(f"${'xyz'[sides[1]]}$ (m)")
    return path


def draw_waypoints(axes: Axes, places: Iterable[Iterable[float]]) -> None:
    """Draw a numbered circle for each waypoint, at its place in the panel."""
    for number, (x, y) in enumerate(places, start=1):
        axes.plot(x, y, "o", ms=8, mfc="white", mec=BLACK, mew=0.8, zorder=5)
        axes.text(x, y, str(number), size="x-small", ha="center", va="center", zorder=6)


def _draw_path(axes: Axes, subject: Subject, points: Array) -> ScalarMappable | None:
    """Draw `points`, any unit, shape (n, 2), one for each row of the true states.

    Their colour is the clearance. Return the points; None if the clearance is unknown.
    """
    clearance = subject.flight.clearance
    if not len(clearance):
        axes.plot(*points.T, color=BLACK, lw=1.4)
        return None
    x, y = points.T
    path = axes.scatter(x, y, s=2, c=clearance, cmap="viridis", rasterized=True, zorder=4)
    path.set_clim(0.0, CLEARANCE_SHOWN)
    return path


def _draw_obstacles(axes: Axes, subject: Subject, sides: tuple[int, int]) -> None:
    """Draw tubes and other bodies as shadows; in an SVG file they are a bitmap."""
    tubes = subject.flight.scene.tubes
    names = {tube.name for tube in tubes}
    bodies = [each for each in subject.shapes.scene if each.body not in names]
    for surface in [*(wall(tube, NO_COLOUR) for tube in tubes), *bodies]:
        triangles: Any = surface.corners[surface.triangles][..., sides]
        colour = GREY if surface.body == subject.flight.mission.touched else LIGHT
        shadow = PolyCollection(triangles, color=colour, rasterized=True, zorder=1.5)
        shadow.set(lw=0, antialiased=False)  # else the edges of the triangles show
        axes.add_collection(shadow, autolim=False)


def _draw_clearance(axes: Axes, subject: Subject) -> None:
    """Draw the clearance over the distance moved."""
    clearance = subject.flight.clearance
    steps = np.linalg.norm(np.diff(subject.flight.truth["position"], axis=0), axis=1)
    moved = np.concatenate([[0.0], np.cumsum(steps)])
    _draw_path(axes, subject, np.stack([moved, clearance], axis=1))
    axes.set_ylim(min(0.0, float(clearance.min())), CEILING)
    axes.set_xlabel("distance moved (m)")
    axes.set_ylabel("clearance (m)")
