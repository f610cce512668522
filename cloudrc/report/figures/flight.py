"""Draw the figure of the flight: the path from above, and z and clearance along the path.

A robot that stays on the ground has no panel with z.
"""

from __future__ import annotations

from itertools import pairwise
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection, PolyCollection
from matplotlib.colors import Normalize
from matplotlib.figure import Figure
from matplotlib.patches import Polygon

from cloudrc.geometry.clearance import CLEARANCE_SHOWN, tube_index
from cloudrc.geometry.scene import Tube
from cloudrc.geometry.shapes import rotation
from cloudrc.geometry.tubes import cut_open
from cloudrc.metrics.flight import Array
from cloudrc.report.figures.labels import free_label
from cloudrc.report.figures.projection import POLYGONS_MAX, outline
from cloudrc.report.figures.style import (
    BLACK,
    BORE,
    GREY,
    LIGHT,
    NARROW,
    SKY,
    VERMILION,
    Subject,
    broken,
    distance_moved,
    new_figure,
    own_bodies,
    panel,
    sampled,
)

UP = np.array([0.0, 0.0, 1.0])
BORE_RGBA, WALL_RGBA = (1.0, 1.0, 1.0, 1.0), (0.0, 0.0, 0.0, 1.0)
"""Marks of the two faces of a cut tube."""

CEILING = 2 * CLEARANCE_SHOWN
"""Upper end of the clearance axis [m]."""
NEAR = 1.0
"""Distance from the path up to which obstacles widen the view from above [m]."""
TITLES = {
    "top": "from above",
    "side": "height along the path",
    "margin": "clearance along the path",
}
"""Panel -> its title."""
ALT = "The path from above, with obstacles, and height and clearance along the path."


def _panels(subject: Subject) -> list[str]:
    """Return the names of the panels of a flight."""
    side = [] if subject.shapes.planar else ["side"]
    return ["top", *side, *(["margin"] if len(subject.flight.clearance) else [])]


def caption(subject: Subject) -> str:
    """Return the figure's caption; it describes only what the flight has."""
    tubes, panels = subject.flight.scene.tubes, _panels(subject)
    above = "path from above, waypoints numbered, the robot at its last pose in blue"
    above += ", tubes cut open" if tubes else ""
    above += ", obstacles above the robot dashed" if own_bodies(subject) else ""
    texts = {
        "top": above,
        "side": "height along the path" + (", with the bore of each tube" if tubes else ""),
        "margin": "clearance, the distance from the robot to the nearest obstacle",
    }
    words = [f"({letter}) {texts[name]}" for letter, name in zip("abc", panels, strict=False)]
    text = f"Flight: {'; '.join(words)}."
    if "margin" in panels:
        text += f" The colour is the clearance in all panels; its axis ends at {CEILING:.1f} m."
    return text


def draw(subject: Subject) -> Figure:
    """Draw the path from above, and z and clearance over the distance moved."""
    figure, axes = _arrange(subject)
    for letter, (name, each) in zip("abc", axes.items(), strict=False):
        panel(each, letter, TITLES[name])
    position = subject.flight.truth["position"]
    way = distance_moved(position)
    coloured = _draw_top(axes["top"], subject, position)
    if side := axes.get("side"):
        _draw_side(side, subject, way, position)
    if margin := axes.get("margin"):
        _draw_clearance(margin, subject, way, position)
    right = [each for name, each in axes.items() if name != "top"]
    if right:
        right[-1].set_xlabel("distance moved (m)")
    for each in right[:-1]:
        each.tick_params(labelbottom=False)
        each.sharex(right[-1])
    if coloured is not None:
        bar = figure.colorbar(coloured, ax=right, extend="max", aspect=20 * len(right), pad=0.01)
        bar.set_label("clearance (m)")
        bar.outline.set_linewidth(0.5)
    return figure


def _arrange(subject: Subject) -> tuple[Figure, dict[str, Axes]]:
    """Make the figure with its panels: one at the left, the others at the right or below."""
    top, *right = _panels(subject)
    mosaic: list[Any]
    ratios: dict[str, Any]
    if subject.look.width < NARROW:
        figure = new_figure(5.6 if len(right) > 1 else 4.4, subject.look.width)
        mosaic = [[top], *([name] for name in right)]
        ratios = {"height_ratios": (1.6, *[2.0 / max(len(right), 1)] * len(right))}
    elif right:
        figure = new_figure(3.5, subject.look.width)
        mosaic, ratios = [[top, name] for name in right], {"width_ratios": (1.0, 1.05)}
    else:
        figure, mosaic, ratios = new_figure(3.5, subject.look.width), [[top]], {}
    return figure, figure.subplot_mosaic(mosaic, **ratios)


def _draw_path(axes: Axes, subject: Subject, x: Array, y: Array) -> LineCollection | None:
    clearance, points = subject.flight.clearance, np.stack([x, y], axis=1)
    behind = subject.flight.rows_behind_holes(subject.flight.truth["stamp_ns"])
    if len(clearance) != len(x) or len(x) < 2:
        axes.plot(*broken(points, behind).T, color=BLACK, lw=1.4)
        return None
    ends, is_line = sampled(len(x), behind)
    points = points[ends]
    around = broken(points, np.searchsorted(ends, behind))
    axes.plot(*around.T, color=BLACK, lw=3.0, solid_capstyle="round", zorder=3)
    lines = LineCollection(
        list(np.stack([points[:-1], points[1:]], axis=1)[is_line]),
        cmap="viridis",
        norm=Normalize(0.0, CLEARANCE_SHOWN),
        lw=1.8,
        capstyle="round",
        zorder=4,
    )
    lines.set_array(np.minimum.reduceat(clearance, ends[:-1])[is_line])
    axes.add_collection(lines)
    axes.autoscale_view()
    return lines


def _draw_top(axes: Axes, subject: Subject, position: Array) -> LineCollection | None:
    for tube in subject.flight.scene.tubes:
        _draw_tube(axes, tube)
    coloured = _draw_path(axes, subject, position[:, 0], position[:, 1])
    for number, waypoint in enumerate(subject.flight.mission.waypoints, start=1):
        place = waypoint.position_m[:2]
        axes.plot(*place, "o", ms=4, mfc="white", mec=BLACK, mew=0.8, zorder=5)
        free_label(axes, str(number), place)
    _draw_obstacles(axes, subject, position)
    _draw_robot(axes, subject)
    axes.set_aspect("equal", adjustable="datalim")
    axes.autoscale_view()
    axes.set_xlabel("$x$ (m)")
    axes.set_ylabel("$y$ (m)")
    return coloured


def _draw_tube(axes: Axes, tube: Tube) -> None:
    """Draw a tube from above, cut open along its axis: the bore, and the wall around it."""
    for surface in cut_open(tube, UP, BORE_RGBA, WALL_RGBA, station=tube.length):
        colour, zorder = (BORE, 1) if surface.rgba == BORE_RGBA else (GREY, 2)
        polygons = [corners[:, :2] for faces in surface.faces for corners in surface.corners[faces]]
        axes.add_collection(
            PolyCollection(polygons, fc=colour, ec=colour, linewidths=0.2, zorder=zorder)
        )


def _draw_obstacles(axes: Axes, subject: Subject, position: Array) -> None:
    """Draw what the scene has besides tubes; what is near the path widens the view."""
    around = np.concatenate([[subject.flight.scene.spawn], position])
    low, high = around.min(axis=0) - NEAR, around.max(axis=0) + NEAR
    top = high[2] - NEAR + subject.shapes.size / 2
    for surface in own_bodies(subject):
        corners = surface.corners
        if (corners.min(axis=0) <= high).all() and (corners.max(axis=0) >= low).all():
            axes.update_datalim(np.clip(corners, low, high)[:, :2])
        is_above = corners[:, 2].min() > top
        colour = BLACK if surface.body == subject.touch else LIGHT
        if is_above or surface.convex:
            look = {"fc": "none", "ls": "--"} if is_above else {"fc": colour}
            hull = outline(corners[:, :2])
            axes.add_patch(Polygon(hull, closed=True, ec=GREY, lw=0.6, zorder=1.5, **look))
            continue
        polygons = corners[surface.triangles][:, :, :2]
        axes.add_collection(
            PolyCollection(
                list(polygons),
                fc=colour,
                ec=colour,
                linewidths=0.2,
                rasterized=len(polygons) > POLYGONS_MAX,
                zorder=1.2,
            ),
            autolim=False,
        )


def _draw_robot(axes: Axes, subject: Subject) -> None:
    """Draw the robot from above at its last pose."""
    truth = subject.flight.truth
    if not len(truth["stamp_ns"]):
        return
    position, axes_of = truth["position"][-1], rotation(truth["orientation_wxyz"][-1])
    for surface in subject.shapes.robot:
        hull = outline(surface.placed(position, axes_of).corners[:, :2])
        axes.add_patch(Polygon(hull, closed=True, fc=SKY, ec="none", alpha=0.5, zorder=2.5))


def _draw_side(axes: Axes, subject: Subject, flown: Array, position: Array) -> None:
    for tube, begin, end in _passages(subject, flown, position):
        low, high = tube.centre[2] - tube.inner, tube.centre[2] + tube.inner
        axes.fill_between([begin, end], low, high, color=BORE, lw=0, zorder=1)
        axes.hlines([low, high], begin, end, color=GREY, lw=1.5, zorder=2)
    axes.axhline(subject.flight.scene.floor, color=BLACK, lw=0.8)
    _draw_path(axes, subject, flown, position[:, 2])
    axes.margins(y=0.12)
    axes.set_ylabel("$z$ (m)")


def _passages(subject: Subject, flown: Array, position: Array) -> list[tuple[Tube, float, float]]:
    """List each flight through a tube: the tube, and the distance flown to entry and exit [m]."""
    inside = tube_index(subject.flight.scene, position)
    changes = np.flatnonzero(np.diff(inside, prepend=-1, append=-1))
    return [
        (subject.flight.scene.tubes[inside[first]], float(flown[first]), float(flown[last - 1]))
        for first, last in pairwise(changes)
        if inside[first] >= 0
    ]


def _draw_clearance(axes: Axes, subject: Subject, flown: Array, position: Array) -> None:
    axes.set_ylabel("clearance (m)")
    flight, clearance = subject.flight, subject.flight.clearance
    for _, begin, end in _passages(subject, flown, position):
        axes.axvspan(begin, end, color=BORE, lw=0, zorder=0)
    _draw_path(axes, subject, flown, clearance)
    axes.set_ylim(min(0.0, float(clearance.min())), CEILING)
    axes.set_xlim(0.0, max(float(flown[-1]), 1e-3))
    rows = flight.inside if flight.scene.tubes else np.ones(len(clearance), dtype=bool)
    if rows.any():
        row = np.where(rows, clearance, np.inf).argmin()
        lowest = flown[row], clearance[row]
        if lowest[1] < CEILING:
            axes.plot(*lowest, "o", ms=4, mfc="none", mec=VERMILION, zorder=6)
            free_label(axes, f"{lowest[1]:.3f} m", lowest, color=VERMILION)
