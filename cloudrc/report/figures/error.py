"""Draw the figure of errors: distance to the setpoint (as in the paper), and estimation error."""

from __future__ import annotations

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from cloudrc.metrics.flight import Array, rms
from cloudrc.report.figures.marks import legend, mark_events
from cloudrc.report.figures.style import (
    ESTIMATED,
    MEASURED,
    PAGE,
    SKY,
    Subject,
    legend_above,
    new_figure,
    panel,
    time_axis,
)

ALT = "Two line plots over time: distance to the setpoint, and the error of the estimate."
CAPTION = (
    "Errors. (a) Distance from the reference to the measured and to the estimated position, as in "
    "the paper. The distance to the next waypoint dominates both curves; a lower estimated curve "
    "says nothing about how accurate the estimate is. (b) Accuracy of the estimate: distance from "
    "the position estimated for each command to the true position when the command was applied. "
    "Each dot is one command, the line is the RMS over half a second. RMS values in the legends "
    "are over the whole flight."
)
SPAN = 0.5
"""Length of the window of the moving RMS [s]."""


def caption(subject: Subject) -> str:
    """Write the caption."""
    return CAPTION + legend(subject)


def draw(subject: Subject) -> Figure:
    """Draw both panels."""
    figure = new_figure(PAGE, 2.6)
    tracking, accuracy = figure.subplots(1, 2)
    _draw_tracking(tracking, subject)
    _draw_accuracy(accuracy, subject)
    return figure


def _draw_tracking(axes: Axes, subject: Subject) -> None:
    panel(axes, "a")
    control = subject.flight.control
    time = subject.flight.seconds(control["stamp_ns"])
    for name, column, colour, width in (
        ("measured", "measured", MEASURED, 1.8),
        ("estimated", "position", ESTIMATED, 1.1),
    ):
        error = control["setpoint"] - control[column]
        label = f"{name}{_rms(rms(error), 'm', 1.0)}"
        axes.plot(time, np.linalg.norm(error, axis=1), color=colour, lw=width, label=label)
    _finish(axes, subject, "distance to reference (m)")


def _draw_accuracy(axes: Axes, subject: Subject) -> None:
    panel(axes, "b")
    applied = subject.flight.applied
    error = applied["position"] - subject.flight.true_position(applied["stamp_ns"])
    time = subject.flight.seconds(applied["stamp_ns"])
    distance = np.linalg.norm(error, axis=1) * 1e3
    axes.plot(time, distance, ".", ms=2.0, mew=0, color=SKY, rasterized=True)
    axes.plot([], [], "o", ms=3.5, mew=0, color=SKY, label="each command")
    label = f"over {SPAN:g} s{_rms(rms(error), 'mm', 1e3)}"
    axes.plot(time, _moving_rms(time, distance), color=ESTIMATED, label=label)
    _finish(axes, subject, "distance to truth (mm)")


def _moving_rms(time: Array, values: Array) -> Array:
    """Compute at each instant the RMS of the values in the last `SPAN` seconds."""
    known = np.isfinite(values)
    squares = np.concatenate([[0.0], np.cumsum(np.where(known, np.square(values), 0.0))])
    counts = np.concatenate([[0], np.cumsum(known)])
    first = np.searchsorted(time, time - SPAN)
    rows = np.arange(1, len(time) + 1)
    means: Array = (squares[rows] - squares[first]) / np.maximum(counts[rows] - counts[first], 1)
    return np.asarray(np.sqrt(means))


def _rms(value: float | None, unit: str, scale: float) -> str:
    return "" if value is None else f" (RMS {value * scale:.3g} {unit})"


def _finish(axes: Axes, subject: Subject, label: str) -> None:
    axes.set_ylim(bottom=0.0)
    mark_events(axes, subject)
    time_axis(axes, subject.duration)
    axes.set_ylabel(label)
    legend_above(axes, 2)
