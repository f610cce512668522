"""Place labels in a figure so that none lies on a curve, a dot or another label."""

from __future__ import annotations

from itertools import product
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure
from matplotlib.path import Path
from matplotlib.transforms import Bbox

FREE = "free"
"""Group id of the labels that `place_labels` moves."""
DISTANCES = (4, 7, 11, 16, 22, 30, 40, 55, 75)
"""Distances from a point to its label that are tried [points]."""
ANGLES = np.radians((90, 270, 45, 315, 135, 225, 0, 180))
"""Directions from a point to its label that are tried, for each distance in turn [rad]."""
PAD = 1.5
"""Space around a label [pixels]."""


def free_label(axes: Axes, text: str, place: Any, **look: Any) -> None:
    """Add a label near `place`; `place_labels` finds its position."""
    look = {"ha": "center", "va": "center", "fontsize": "small", "zorder": 7, **look}
    axes.annotate(text, place, (0, 0), textcoords="offset points", gid=FREE, **look)


def place_labels(figure: Figure) -> None:
    """Fix the layout of a figure, then move its labels to free places."""
    figure.draw_without_rendering()
    figure.set_layout_engine("none")
    for axes in figure.axes:
        labels: list[Any] = [text for text in axes.texts if text.get_gid() == FREE]
        lines, dots = curves(axes) if labels else ([], np.zeros((0, 2)))
        taken: list[Bbox] = []
        for label in labels:
            size = label.get_window_extent().size * 72.0 / figure.dpi
            for distance, angle in product(DISTANCES, ANGLES):
                way = np.round([np.cos(angle), np.sin(angle)], 6)
                label.xyann = distance * way + np.sign(way) * size / 2
                box = label.get_window_extent().padded(PAD)
                inside = axes.bbox.containsx(box.x0) and axes.bbox.containsx(box.x1)
                inside &= axes.bbox.containsy(box.y0) and axes.bbox.containsy(box.y1)
                if inside and is_free(box, lines, dots) and not box.count_overlaps(taken):
                    break
            taken.append(box)


def curves(axes: Axes) -> tuple[list[Path], Any]:
    """Return lines and positions of dots, shape (n, 2), that labels must not cover [pixels]."""
    lines: list[Path] = []
    dots: list[Any] = [np.zeros((0, 2))]
    for line in (line for line in axes.lines if line.get_zorder() > 0):  # 0: background
        path = line.get_transform().transform_path(line.get_path())
        dots.append(path.vertices) if line.get_linestyle() == "None" else lines.append(path)
    for collection in axes.collections:
        if isinstance(collection, LineCollection):
            to_pixels = collection.get_transform()
            lines += [to_pixels.transform_path(path) for path in collection.get_paths()]
    return lines, np.concatenate(dots)


def is_free(box: Bbox, lines: list[Path], dots: Any) -> bool:
    """Return whether a box [pixels] contains no line and no dot."""
    hit = ((dots >= box.min) & (dots <= box.max)).all(axis=1).any()
    return not hit and not any(path.intersects_bbox(box, filled=False) for path in lines)
