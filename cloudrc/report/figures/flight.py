"""Draw the figure of the flight: the path from above, and z and clearance along the path."""

from __future__ import annotations

from itertools import pairwise
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection
from matplotlib.colors import Normalize
from matplotlib.figure import Figure
from matplotlib.patches import Polygon

from cloudrc.geometry.clearance import CLEARANCE_SHOWN, pipe_index
from cloudrc.geometry.scene import Pipe
from cloudrc.metrics.flight import Array
from cloudrc.report.figures.labels import free_label
from cloudrc.report.figures.style import (
    BLACK,
    BORE,
    GREY,
    NARROW,
    VERMILION,
    Subject,
    new_figure,
    panel,
)

CEILING = 2 * CLEARANCE_SHOWN
"""Upper end of the clearance axis in panel (c) [m]."""
ALT = "The flown path from above and from the side through the pipes, coloured by clearance."
CAPTION_PIPES = (
    "Flight. (a) Path from above: pipes cut open, waypoints numbered, the board as a bar. "
    "(b) Height along the path, with the bore of each pipe. "
    "(c) Clearance: distance from the robot (rotors, arm, body) to the nearest wall. The colour is "
    f"the clearance in all three panels. Panel (c) ends at {CEILING:.1f} m; outside the pipes the "
    "clearance can be larger."
)
CAPTION_FREE = "Flight. (a) Path from above, waypoints numbered. (b) Height along the path."


def caption(subject: Subject) -> str:
    """Return the figure's caption; it mentions clearance only if the scene has pipes."""
    return CAPTION_PIPES if subject.flight.scene.pipes else CAPTION_FREE


def draw(subject: Subject) -> Figure:
    """Draw the path from above, and z and clearance over the distance flown."""
    right = ["side", "margin"] if len(subject.flight.clearance) else ["side"]
    mosaic: list[Any]
    ratios: dict[str, Any]
    if subject.look.width < NARROW:
        figure = new_figure(5.6, subject.look.width)
        mosaic = [["top"], *([name] for name in right)]
        ratios = {"height_ratios": (1.6, *[2.0 / len(right)] * len(right))}
    else:
        figure = new_figure(3.5, subject.look.width)
        mosaic, ratios = [["top", name] for name in right], {"width_ratios": (1.0, 1.05)}
    axes = figure.subplot_mosaic(mosaic, **ratios)
    position = subject.flight.truth["position"]
    steps = np.linalg.norm(np.diff(position, axis=0), axis=1)
    flown = np.concatenate([np.zeros(min(len(position), 1)), np.cumsum(steps)])
    coloured, side = _draw_top(axes["top"], subject, position), axes["side"]
    _draw_side(side, subject, flown, position)
    axes[right[-1]].set_xlabel("distance flown (m)")
    if margin := axes.get("margin"):
        side.tick_params(labelbottom=False)
        margin.sharex(side)
        _draw_clearance(margin, subject, flown, position)
        if coloured is not None:
            bar = figure.colorbar(coloured, ax=[side, margin], extend="max", aspect=40, pad=0.01)
            bar.set_label("clearance (m)")
            bar.outline.set_linewidth(0.5)
    return figure


def _draw_path(axes: Axes, subject: Subject, x: Array, y: Array) -> LineCollection | None:
    clearance = subject.flight.clearance
    if len(clearance) != len(x) or len(x) < 2:
        axes.plot(x, y, color=BLACK, lw=1.4)
        return None
    # Draw 20 of the 100 points per second: the path looks smooth, and the file is smaller.
    ends = np.append(np.arange(0, len(x) - 1, 5), len(x) - 1)
    points = np.stack([x, y], axis=1)[ends]
    axes.plot(*points.T, color=BLACK, lw=3.0, solid_capstyle="round", zorder=3)
    lines = LineCollection(
        list(np.stack([points[:-1], points[1:]], axis=1)),
        cmap="viridis",
        norm=Normalize(0.0, CLEARANCE_SHOWN),
        lw=1.8,
        capstyle="round",
        zorder=4,
    )
    lines.set_array(np.minimum.reduceat(clearance, ends[:-1]))
    axes.add_collection(lines)
    axes.autoscale_view()
    return lines


def _draw_top(axes: Axes, subject: Subject, position: Array) -> LineCollection | None:
    panel(axes, "a", "from above")
    for pipe in subject.flight.scene.pipes:
        _draw_pipe(axes, pipe)
    board = subject.flight.scene.board
    if board is not None:
        axes.plot([board.x, board.x], board.y, color=BLACK, lw=3, solid_capstyle="butt", zorder=3)
    coloured = _draw_path(axes, subject, position[:, 0], position[:, 1])
    for number, waypoint in enumerate(subject.flight.mission.waypoints, start=1):
        place = waypoint.position_m[:2]
        axes.plot(*place, "o", ms=4, mfc="white", mec=BLACK, mew=0.8, zorder=5)
        free_label(axes, str(number), place)
    axes.set_aspect("equal", adjustable="datalim")
    axes.set_xlabel("$x$ (m)")
    axes.set_ylabel("$y$ (m)")
    return coloured


def _draw_pipe(axes: Axes, pipe: Pipe) -> None:
    """Draw a pipe from above, cut open along its axis: the bore and the wall on either side."""
    centre, along = np.array(pipe.centre[:2]), np.array(pipe.axis[:2])
    across, half = np.array([-along[1], along[0]]), along * pipe.length / 2
    for low, high, colour, zorder in (
        (-pipe.inner, pipe.inner, BORE, 1),
        (-pipe.inner, -pipe.outer, GREY, 2),
        (pipe.inner, pipe.outer, GREY, 2),
    ):
        corners = [
            centre + end * half + radius * across
            for end, radius in ((-1, low), (1, low), (1, high), (-1, high))
        ]
        axes.add_patch(Polygon(corners, closed=True, fc=colour, ec="none", zorder=zorder))


def _draw_side(axes: Axes, subject: Subject, flown: Array, position: Array) -> None:
    panel(axes, "b", "height along the path")
    for pipe, begin, end in _passages(subject, flown, position):
        low, high = pipe.centre[2] - pipe.inner, pipe.centre[2] + pipe.inner
        axes.fill_between([begin, end], low, high, color=BORE, lw=0, zorder=1)
        axes.hlines([low, high], begin, end, color=GREY, lw=1.5, zorder=2)
    axes.axhline(subject.flight.scene.floor, color=BLACK, lw=0.8)
    _draw_path(axes, subject, flown, position[:, 2])
    axes.margins(y=0.12)
    axes.set_ylabel("$z$ (m)")


def _passages(subject: Subject, flown: Array, position: Array) -> list[tuple[Pipe, float, float]]:
    """List each flight through a pipe: the pipe, and the distance flown to entry and exit [m]."""
    inside = pipe_index(subject.flight.scene, position)
    changes = np.flatnonzero(np.diff(inside, prepend=-1, append=-1))
    return [
        (subject.flight.scene.pipes[inside[first]], float(flown[first]), float(flown[last - 1]))
        for first, last in pairwise(changes)
        if inside[first] >= 0
    ]


def _draw_clearance(axes: Axes, subject: Subject, flown: Array, position: Array) -> None:
    panel(axes, "c", "clearance along the path")
    axes.set_ylabel("clearance (m)")
    flight, clearance = subject.flight, subject.flight.clearance
    for _, begin, end in _passages(subject, flown, position):
        axes.axvspan(begin, end, color=BORE, lw=0, zorder=0)
    _draw_path(axes, subject, flown, clearance)
    axes.set_ylim(min(0.0, float(clearance.min())), CEILING)
    axes.set_xlim(0.0, max(float(flown[-1]), 1e-3))
    if flight.inside.any():
        row = np.where(flight.inside, clearance, np.inf).argmin()
        lowest = flown[row], clearance[row]
        axes.plot(*lowest, "o", ms=4, mfc="none", mec=VERMILION, zorder=6)
        free_label(axes, f"{lowest[1]:.3f} m", lowest, color=VERMILION)
