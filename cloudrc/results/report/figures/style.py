# SPDX-License-Identifier: Apache-2.0

"""Define the style of all figures, and `Subject`, the flight that the figures show.

Fonts and sizes suit a paper with two columns. Colour-blind readers can distinguish the colours.
Source: M. Okabe, K. Ito, "Color Universal Design", 2008.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from cloudrc.config.faults import FaultConfig
from cloudrc.config.profile import DirectionConfig
from cloudrc.physics.geometry.shapes import Shapes
from cloudrc.results.metrics.flight import Array, Flight

PAGE = 7.16
"""Width of both columns of a page [in]. Source: IEEE conference template."""
NARROW = 5.0
"""Figures below this width [in] have their panels below each other."""
BLACK, GREY, LIGHT = "#1a1a1a", "#6b6b6b", "#d9d9d9"
BLUE, SKY, GREEN = "#0072B2", "#56B4E9", "#009E73"
ORANGE, VERMILION, PURPLE = "#E69F00", "#D55E00", "#CC79A7"
UPLINK, DOWNLINK = BLUE, ORANGE
NOTHING = Shapes()
COLOURS, DASHES = (BLUE, VERMILION, GREEN, PURPLE, ORANGE, BLACK, SKY), ("-", "--", "-.", ":")
"""Lines of equal kind take them in turn."""

RC: dict[Any, Any] = {
    "font.family": "serif",  # the first one is shipped with matplotlib, the others for an SVG
    "font.serif": ["STIXGeneral", "STIX Two Text", "Times New Roman", "Times"],
    "mathtext.fontset": "stix",
    "axes.titlesize": "medium",
    **dict.fromkeys(("axes.linewidth", "xtick.major.width", "ytick.major.width"), 0.6),
    **dict.fromkeys(("xtick.major.size", "ytick.major.size"), 3.0),
    **dict.fromkeys(("axes.spines.top", "axes.spines.right", "legend.frameon"), False),
    **dict.fromkeys(("axes.grid", "axes.axisbelow"), True),
    "grid.linewidth": 0.5,
    "axes.edgecolor": BLACK,
    "grid.color": "#e6e6e6",
    "lines.linewidth": 1.1,
    "legend.handlelength": 1.6,
    "legend.borderaxespad": 0.2,
    "svg.fonttype": "none",  # text stays text
    "pdf.fonttype": 42,
    "svg.hashsalt": "cloudrc",  # the same flight gives an identical file
    "savefig.dpi": 200,
}
"""Settings of matplotlib for figures of any size."""


@dataclass(frozen=True, slots=True)
class Look:
    """Width and font size of figures in print."""

    width: float = PAGE  # of the figure [in]
    font_size: float = 9.0  # of titles and labels; numbers at axes are 1 point smaller [points]

    @property
    def settings(self) -> dict[Any, Any]:
        """Settings of matplotlib while a figure is drawn and saved."""
        small = ("xtick.labelsize", "ytick.labelsize", "legend.fontsize")
        return {**RC, "font.size": self.font_size, **dict.fromkeys(small, self.font_size - 1.0)}

    def two_panels(self) -> tuple[Figure, list[Axes]]:
        """Make a figure with two panels, one below the other if the figure is narrow."""
        narrow = self.width < NARROW
        figure = new_figure(4.16 if narrow else 2.6, self.width)
        return figure, [*(figure.subplots(2, 1) if narrow else figure.subplots(1, 2))]


def new_figure(height: float, width: float = PAGE) -> Figure:
    """Make an empty figure of `height` [in] and `width` [in], without a display or pyplot."""
    return Figure(figsize=(width, height), layout="constrained")


def panel(axes: Axes, letter: str, title: str = "") -> None:
    """Write a panel's letter and optional title above it."""
    axes.set_title(f"({letter}) {title}".rstrip(), loc="left")


def legend_above(axes: Axes) -> None:
    """Draw the legend of a panel, if there is one, above the panel."""
    if axes.get_legend_handles_labels()[0]:
        axes.legend(
            loc="lower right",
            bbox_to_anchor=(1.0, 1.0),
            ncols=4,
            columnspacing=1.0,
            handletextpad=0.4,
        )


def dots(axes: Axes, x: Array, y: Array, colour: str, name: str) -> None:
    """Draw dots at `x` and `y`, any unit, and add them to the legend.

    In an SVG file the dots are a bitmap, because thousands of vector shapes are slow to display.
    """
    axes.plot(x, y, ".", ms=1.8, mew=0, color=colour, rasterized=True, zorder=2)
    axes.plot([], [], "o", ms=3.5, mew=0, color=colour, label=name)


@dataclass(frozen=True, slots=True)
class Subject:
    """What the figures show: a flight, and the two link profiles at its start."""

    flight: Flight
    uplink: DirectionConfig
    downlink: DirectionConfig
    look: Look = Look()
    shapes: Shapes = NOTHING  # of robot and scene
    link_start: float = 0.0  # where the schedule of the link begins [s]
    faults: tuple[FaultConfig, ...] = ()  # that the experiment injects

    @property
    def times(self) -> Array:
        """Times of the control periods since the start of the mission [s], shape (n,)."""
        return np.asarray(self.flight.seconds(self.flight.control["stamp_ns"]))
