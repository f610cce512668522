# SPDX-License-Identifier: Apache-2.0

"""Draw where the age of the commands comes from: one bar per stage."""

from __future__ import annotations

from itertools import accumulate, cycle
from typing import Any

from matplotlib.axes import Axes
from matplotlib.figure import Figure

from cloudrc.results.metrics.budget import budget_of
from cloudrc.results.report.figures import style
from cloudrc.results.report.figures.style import COLOURS, Subject, legend_above, new_figure

ALT = "A bar chart: the mean duration of each stage of a command, one below the other."
CAPTION = (
    "Budget of the age. Each bar is the mean duration of a stage of the commands that the robot "
    "followed; it begins where the stage before ends, so the last one ends at the mean age when a "
    "command begins to act. The line behind a bar ends at the 99th percentile of its stage. The "
    "dashed line is the age averaged over time: a command ages on while the robot follows it. "
    "With a perception, the lower bars are the way from a scan until the robot acts on it."
)


def draw(subject: Subject) -> Figure:
    """Draw the stages of the commands that the robot followed."""
    found = budget_of(subject.flight).document
    parts = [each for each in (found, (found or {}).get("scans")) if each]
    counts = [len(each["stages"]) for each in parts] or [1]
    height = 0.9 * len(counts) + 0.28 * sum(counts)
    figure = new_figure(height, subject.look.width)
    ratios = {"height_ratios": counts}
    every = figure.subplots(len(counts), sharex=True, squeeze=False, gridspec_kw=ratios).flat
    for axes, each in zip(every, parts or [None], strict=True):
        _draw_stages(axes, each)
    every[len(counts) - 1].set_xlabel("time since the measurement (ms)")
    legend_above(every[0])
    return figure


def _draw_stages(axes: Axes, found: dict[str, Any] | None) -> None:
    """Draw the stages of a budget, which may be unknown."""
    stages = [*found["stages"].values()] if found else []
    begins = accumulate((1e3 * each["mean"] for each in stages), initial=0.0)
    drawn = zip(stages, begins, cycle(COLOURS), strict=False)
    for row, (each, begin, colour) in enumerate(drawn):
        _draw_stage(axes, row, begin, 1e3 * each["mean"], 1e3 * each["p99"], colour)
    axes.set_yticks(range(len(stages)), [each["text"] for each in stages])
    axes.invert_yaxis()
    axes.grid(visible=False, axis="y")
    if found and found["time_average"] is not None:
        look: dict[str, Any] = {"color": style.BLACK, "lw": 0.9, "ls": "--"}
        axes.axvline(1e3 * found["time_average"], label="time average of the age", **look)
    axes.set_xlim(left=0.0)


def _draw_stage(axes: Axes, row: int, begin: float, mean: float, p99: float, colour: str) -> None:
    """Draw a stage that begins at `begin`; all times in [ms]."""
    axes.barh(row, mean, left=begin, height=0.62, color=colour, zorder=3)
    axes.plot([begin, begin + p99], [row, row], color=style.GREY, lw=0.9, zorder=2)
    axes.plot(begin + p99, row, "|", color=style.GREY, ms=6.0, zorder=2)
    axes.annotate(
        f"{mean:.1f}", (begin + max(mean, p99), row), (5, 0), textcoords="offset points",
        va="center", fontsize="small",
    )  # fmt: skip
