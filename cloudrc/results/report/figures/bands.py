# SPDX-License-Identifier: Apache-2.0

"""Draw the figure of a sweep: a panel per quantity, a line per setting, an interval per point."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from itertools import cycle
from math import isfinite, nan
from typing import Any, NamedTuple

import numpy as np
from matplotlib.axes import Axes

from cloudrc.results.report.figures import PRINT_KINDS, own_settings, save, style
from cloudrc.results.report.figures.style import COLOURS, DASHES, Look, new_figure, panel

UNITS = {"ms": "ms", "s": "s", "m": "m", "mps": "m/s", "kbit": "kbit/s", "deg": "deg"}
"""Suffix of a configuration key -> unit."""
MARKERS = ("o", "s", "^", "D", "v", "P", "X", "*")
"""Lines take them in turn. The counts of colours and markers have no common factor: only after 56
lines does a pair of both come again."""

WAYS = {"both": "each way", "uplink": "of the uplink", "downlink": "of the downlink"}
"""Part of the link in a key -> words."""
AXIS, PANEL, ALONE, LEGEND_ROW = 0.4, 1.3, 2.1, 0.19
"""Heights of the x axis, of one of several panels, of a single panel, and of a row of the legend
[in]."""
LETTERS_MAX = 100
"""Letters along x that have room in an inch at a size of one point."""


class Point(NamedTuple):
    """A point of a line: a value, and its interval from `low` to `high`; NaN if unknown."""

    x: float  # any unit, or the index of a name
    middle: float  # any unit
    low: float  # likewise
    high: float  # likewise
    failed: bool  # whether some of its flights failed


@dataclass(frozen=True, slots=True)
class Panel:
    """One panel of the figure: a quantity, its unit, and a line of points per setting."""

    title: str
    unit: str
    lines: Mapping[str, Sequence[Point]]
    baseline: float = nan  # value without a network, a dashed line, any unit
    marks: Mapping[str, float] = field(default_factory=dict)  # name -> x of a vertical line
    is_log: bool = False  # whether its axis is logarithmic


def draw(
    panels: Sequence[Panel],
    x: str,
    x_names: Sequence[str],
    by: str | None,
    *,
    look: Look,
    hollow: str = "hollow: a flight failed",
) -> dict[str, bytes]:
    """Draw panels below each other; return the contents of a PDF, a PNG and an SVG file by suffix.

    `x` is the key that varies along the x axis, `by` the key that varies between lines (None: one
    line). With `x_names`, the x axis has names instead of numbers, and no line joins the points.
    `hollow` says what hollow markers mean.
    """
    with own_settings(look):
        crowded = sum(map(len, x_names)) > LETTERS_MAX * look.width / look.font_size
        height = PANEL * len(panels) if len(panels) > 1 else ALONE
        figure = new_figure(height + crowded, look.width)
        column = figure.subplots(len(panels), 1, sharex=True, squeeze=False)[:, 0]
        for n, (axes, each) in enumerate(zip(column, panels, strict=True)):
            _draw_panel(axes, each, named=bool(x_names))
            title = each.title + f" ({each.unit})" * bool(each.unit)
            if len(panels) > 1:
                panel(axes, chr(ord("a") + n), title)
            else:
                axes.set_title(title, loc="left")
        column[-1].set_xlabel(_label(x))
        if x_names:
            column[-1].set_xticks(range(len(x_names)), x_names)
            column[-1].set_xlim(-0.5, len(x_names) - 0.5)
            if crowded:
                column[-1].tick_params(axis="x", rotation=90)
        points = (point for each in panels for line in each.lines.values() for point in line)
        if any(point.failed for point in points):
            marker: dict[str, Any] = {"marker": "o", "ms": 4, "mfc": "white", "color": style.GREY}
            column[0].plot([], [], ls="none", label=hollow, **marker)
        lines, names = column[0].get_legend_handles_labels()
        if by:
            shape = {"ncols": 2, "alignment": "left", "title_fontsize": look.font_size - 1.0}
            figure.legend(lines, names, loc="outside upper left", title=_label(by), **shape)
            height += LEGEND_ROW * (1 + (len(names) + 1) // 2)
        figure.set_figheight(height + crowded + AXIS)
        return {kind: save(figure, kind) for kind in PRINT_KINDS}


def _draw_panel(axes: Axes, content: Panel, *, named: bool) -> None:
    for index, (name, points) in enumerate(content.lines.items()):
        colour, marker, dashes = (each[index % len(each)] for each in (COLOURS, MARKERS, DASHES))
        look: dict[str, Any] = {"color": colour, "marker": marker, "ms": 4}
        x, middle, low, high, failed = np.array(points, dtype=float).T
        if named:  # side by side, so that no marker hides another
            x = x + (index - (len(content.lines) - 1) / 2) * min(0.12, 0.9 / len(content.lines))
            bars = (middle - low, high - middle)
            axes.errorbar(x, middle, bars, ls="none", capsize=2, label=name, **look)
        else:
            axes.fill_between(x, low, high, color=colour, alpha=0.18, lw=0)
            axes.plot(x, middle, ls=dashes, label=name, **look)
        bad = failed > 0
        axes.plot(x[bad], middle[bad], ls="none", mfc="white", zorder=5, **look)
    if isfinite(content.baseline):
        look = {"color": style.GREY, "lw": 0.9, "zorder": 1}
        axes.axhline(content.baseline, ls=(0, (5, 3)), label="no network", **look)
    for (name, x), dots in zip(content.marks.items(), cycle(DASHES[3:] + DASHES[2:3])):
        axes.axvline(x, color=style.GREY, lw=0.9, ls=dots, zorder=1, label=name)
    if content.is_log:
        axes.set_yscale("log")
        axes.yaxis.set_major_formatter("{x:g}")
        axes.minorticks_off()
    else:
        axes.ticklabel_format(axis="y", useOffset=False)
    if content.unit == "%":
        axes.set_ylim(-5.0, 105.0)


def _label(key: str) -> str:
    """Write a key in words, its unit in parentheses: "delay each way (ms)"."""
    name, _, end = key.rpartition("_")
    name, unit = (name, f" ({UNITS[end]})") if end in UNITS else (key, "")
    section, _, rest = name.partition(".")
    way, _, what = rest.partition(".")
    words = f"{what} {WAYS[way]}" if section == "link" and way in WAYS else rest or name
    return words.replace(".", " ").replace("_", " ") + unit
