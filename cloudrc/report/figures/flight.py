"""Draw the figure of the flight: the path from above and from the side, and its clearance.

A robot that stays on the ground has no panel from the side.
"""

from __future__ import annotations

from itertools import pairwise
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection
from matplotlib.colors import Normalize
from matplotlib.figure import Figure
from matplotlib.patches import Polygon

from cloudrc.geometry.clearance import CLEARANCE_SHOWN, rotations
from cloudrc.geometry.scene import Tube
from cloudrc.geometry.tubes import rims
from cloudrc.metrics.flight import Array
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
    legend_above,
    new_figure,
    panel,
    sampled,
)

CEILING = 2 * CLEARANCE_SHOWN
"""Upper end of the clearance axis [m]."""
SHADES = 40
"""Number of colours of the path."""
NEAR = 1.0
"""Distance from the path up to which obstacles widen a view [m]."""
ALT = "The path from above and from the side, with outlines of obstacles, and its clearance."
TITLES = {"top": "from above", "side": "from the side", "margin": "clearance"}
"""Panel -> its title."""
TEXTS = {
    "top": "path from above",
    "side": "path from the side",
    "margin": "clearance, the distance from the robot to the nearest obstacle",
}
"""Panel -> its part of the caption."""


def _panels(subject: Subject) -> list[str]:
    """Return the names of the panels of a flight."""
    side = [] if subject.shapes.planar else ["side"]
    return ["top", *side, *(["margin"] if len(subject.flight.clearance) else [])]


def caption(subject: Subject) -> str:
    """Return the figure's caption; it describes only what the flight has."""
    panels = _panels(subject)
    words = [f"({letter}) {TEXTS[name]}" for letter, name in zip("abc", panels, strict=False)]
    text = f"Flight: {'; '.join(words)}."
    flight = subject.flight
    text += " Circles: waypoints." if flight.mission.waypoints else ""
    if flight.scene.tubes or subject.shapes.scene:
        text += " Grey: outlines of obstacles, dashed if they are above the robot."
    text += " Blue: the robot at its last pose." if subject.shapes.robot else ""
    if "margin" in panels:
        text += f" The colour is the clearance in all panels; its axis ends at {CEILING:.1f} m."
    return text


def draw(subject: Subject) -> Figure:
    """Draw the path from above, from the side, and its clearance over the distance moved."""
    figure, axes = _arrange(subject)
    for letter, (name, each) in zip("abc", axes.items(), strict=False):
        panel(each, letter, TITLES[name])
    coloured = _draw_view(axes["top"], subject, (0, 1))
    axes["top"].set_aspect("equal", adjustable="datalim")
    if side := axes.get("side"):
        extent = np.ptp(_shown(subject), axis=0)
        _draw_view(side, subject, (int(extent[1] > extent[0]), 2))
        side.axhline(subject.flight.scene.floor, color=BLACK, lw=0.8)
    if margin := axes.get("margin"):
        _draw_clearance(margin, subject)
    if coloured is not None:
        right = [each for name, each in axes.items() if name != "top"]
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


def _shown(subject: Subject) -> Array:
    """Return the points that each view shows [m], shape (n, 3): spawn, waypoints and path."""
    flight = subject.flight
    waypoints = [waypoint.position_m for waypoint in flight.mission.waypoints]
    return np.array([flight.scene.spawn, *waypoints, *flight.truth["position"]])


def _draw_view(axes: Axes, subject: Subject, sides: tuple[int, int]) -> LineCollection | None:
    """Draw path, obstacles and robot over two axes of the world, 0 to 2; return the path."""
    _draw_waypoints(axes, subject, sides)
    _draw_obstacles(axes, subject, sides)
    _draw_robot(axes, subject, sides)
    coloured = _draw_path(axes, subject, subject.flight.truth["position"][:, sides])
    axes.margins(0.08)
    axes.autoscale_view()
    axes.set_xlabel(f"${'xyz'[sides[0]]}$ (m)")
    axes.set_ylabel(f"${'xyz'[sides[1]]}$ (m)")
    return coloured


def _draw_waypoints(axes: Axes, subject: Subject, sides: tuple[int, int]) -> None:
    """Draw the waypoints; their numbers stand in the view from above, where few hide each other."""
    numbered = sides == (0, 1)
    look: dict[str, Any] = {"ms": 8 if numbered else 4, "mfc": "white", "mec": BLACK, "mew": 0.8}
    for number, waypoint in enumerate(subject.flight.mission.waypoints, start=1):
        x, y = (waypoint.position_m[side] for side in sides)
        axes.plot(x, y, "o", zorder=5, **look)
        if numbered:
            text = axes.text(x, y, str(number), size="x-small", ha="center", zorder=6)
            text.set_verticalalignment("center_baseline")


def _draw_path(axes: Axes, subject: Subject, points: Array) -> LineCollection | None:
    """Draw a line through `points`, any unit, shape (n, 2), one for each row of the true states.

    Its colour is the clearance. Return the line; None if the clearance is unknown.
    """
    flight = subject.flight
    behind = flight.rows_behind_holes(flight.truth["stamp_ns"])
    if len(flight.clearance) != len(points) or len(points) < 2:
        axes.plot(*broken(points, behind).T, color=BLACK, lw=1.4)
        return None
    rows = sampled(len(points), behind)
    points, holes = points[rows], np.searchsorted(rows, behind)
    axes.plot(*broken(points, holes).T, color=BLACK, lw=3.0, solid_capstyle="round", zorder=3)
    shade = np.minimum(flight.clearance / CLEARANCE_SHOWN, 1.0) * SHADES
    shade = np.rint(np.minimum.reduceat(shade, rows))
    begins = np.union1d(np.flatnonzero(np.diff(shade)) + 1, holes).astype(int)
    # Each part goes on to the first point of the next one, but not across a hole.
    spans = pairwise([0, *begins, len(points)])
    parts = [points[first : last + (last not in holes)] for first, last in spans]
    lines = LineCollection(
        parts,
        cmap="viridis",
        norm=Normalize(0.0, CLEARANCE_SHOWN),
        lw=1.8,
        capstyle="round",
        zorder=4,
    )
    lines.set_array(shade[[0, *begins]] * CLEARANCE_SHOWN / SHADES)
    axes.add_collection(lines)
    return lines


def _draw_obstacles(axes: Axes, subject: Subject, sides: tuple[int, int]) -> None:
    """Draw outlines of tubes and other bodies; what is near the path widens the view."""
    shown = _shown(subject)
    low, high = shown.min(axis=0) - NEAR, shown.max(axis=0) + NEAR
    top = high[2] - NEAR + subject.shapes.size / 2
    tubes = subject.flight.scene.tubes
    bodies = [(tube.name, _corners(tube), BORE) for tube in tubes]
    known = {tube.name for tube in tubes}
    others = [each for each in subject.shapes.scene if each.body not in known]
    bodies += [(each.body, each.corners, LIGHT) for each in others]
    for name, corners, colour in bodies:
        if (corners.min(axis=0) <= high).all() and (corners.max(axis=0) >= low).all():
            axes.update_datalim(np.clip(corners, low, high)[:, sides])
        is_above = sides == (0, 1) and corners[:, 2].min() > top
        look: dict[str, Any] = {"fc": "none" if is_above else colour, "alpha": 0.7}
        look |= {"ls": "--" if is_above else "-", "ec": BLACK if name == subject.touch else GREY}
        axes.add_patch(Polygon(outline(corners[:, sides]), lw=0.8, zorder=1.5, **look))


def _corners(tube: Tube) -> Array:
    """Return points on both ends of a tube [m], world frame, shape (n, 3)."""
    return np.concatenate([rim.corners for rim in rims(tube, (0.0, 0.0, 0.0, 1.0))])


def _draw_robot(axes: Axes, subject: Subject, sides: tuple[int, int]) -> None:
    """Draw the robot at its last pose."""
    truth = subject.flight.truth
    if not len(truth["stamp_ns"]):
        return
    position, axes_of = truth["position"][-1], rotations(truth["orientation_wxyz"][-1:])[0]
    for surface in subject.shapes.robot:
        hull = outline(surface.placed(position, axes_of).corners[:, sides])
        axes.add_patch(Polygon(hull, fc=SKY, ec="none", alpha=0.5, zorder=2.5))


def _draw_clearance(axes: Axes, subject: Subject) -> None:
    """Draw the clearance over the distance moved, and mark the least one that counts."""
    flight, clearance = subject.flight, subject.flight.clearance
    steps = np.linalg.norm(np.diff(flight.truth["position"], axis=0), axis=1)
    moved = np.concatenate([[0.0], np.cumsum(steps)])
    _draw_path(axes, subject, np.stack([moved, clearance], axis=1))
    axes.set_ylim(min(0.0, float(clearance.min())), CEILING)
    axes.set_xlim(0.0, max(float(moved[-1]), 1e-3))
    axes.set_xlabel("distance moved (m)")
    axes.set_ylabel("clearance (m)")
    counts = flight.inside if flight.scene.tubes else np.ones(len(clearance), dtype=bool)
    if counts.any():
        row = np.where(counts, clearance, np.inf).argmin()
        look: dict[str, Any] = {"ms": 4, "mfc": "none", "mec": VERMILION, "ls": "none", "zorder": 6}
        place = moved[row], clearance[row]
        axes.plot(*place, "o", label=f"least: {clearance[row]:.3f} m", **look)
        legend_above(axes, 1)


def outline(points: Array) -> Array:
    """Return the convex hull of `points` [m] in a plane, shape (n, 2), counter-clockwise."""
    ordered = np.unique(points, axis=0).tolist()
    if len(ordered) < 3:
        return np.array(ordered).reshape(-1, 2)
    halves = []
    for line in (ordered, ordered[::-1]):
        hull: list[list[float]] = []
        for point in line:
            while len(hull) > 1 and _turn(hull[-2], hull[-1], point) <= 0.0:
                hull.pop()
            hull.append(point)
        halves.append(hull[:-1])
    return np.array(halves[0] + halves[1])


def _turn(a: list[float], b: list[float], c: list[float]) -> float:
    """Return twice the area of a triangle, positive if counter-clockwise."""
    return (b[0] - a[0]) * (c[1] - a[1]) - (b[1] - a[1]) * (c[0] - a[0])
