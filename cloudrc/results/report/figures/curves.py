# SPDX-License-Identifier: Apache-2.0

"""Draw the figures over time: delays, position per axis, and errors."""

from __future__ import annotations

from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from cloudrc.results.metrics.control import prediction_errors, round_trips, tracking_errors
from cloudrc.results.metrics.flight import Array, rms
from cloudrc.results.report.figures import style
from cloudrc.results.report.figures.marks import bounds, mark_events
from cloudrc.results.report.figures.style import Subject, dots, legend_above, new_figure, panel

DELAY_ALT = "Two scatter plots over time: one-way delays, and the loop delay with its estimate."
DELAY = (
    "Delays. (a) Each dot is the one-way delay of a datagram that arrived, late ones included; the "
    "band is the link profile, with gaps in blackouts. Without dots, the two ends do not share a "
    "clock. Delays far above the others are cut off. (b) Each dot is the loop delay of one echo: "
    "the time from a command's stamp to its first echo. The solid line is the delay "
    "estimate, over which the controller predicts. The band is the sum of both directions of the "
    "link profile, the dashed line its mean. Only applied commands have echoes; if the newest "
    "command wins, these are the fast ones, so the loop delay lies below the mean of the profile."
)
TIME = "time since start (s)"
"""Label of the time axis; the report page finds panels over time by this label."""
MARGIN = 1.25
"""Ratio of the upper end of the delay axis to the 99.5th percentile of the delays."""


def draw_delay(subject: Subject) -> Figure:
    """Draw the one-way delay of each datagram, and the loop delay with cloud's estimate of it.

    The bands are the limits of the link profile in force, if they are known.
    """
    figure, (one_way, loop) = subject.look.two_panels()
    flight, time = subject.flight, _steps(subject)
    panel(one_way, "a")
    for name, colour in (("uplink", style.UPLINK), ("downlink", style.DOWNLINK)):
        arrivals = flight.during(f"/{name}_delay")
        dots(one_way, flight.seconds(arrivals["stamp_ns"]), arrivals["delay"] * 1e3, colour, name)
    for each, label in zip(_limits(subject), ("profile", "_"), strict=True):
        _fill(one_way, time, each, label)
    _finish_delay(one_way, subject, "one-way delay (ms)")

    panel(loop, "b")
    draw_loop(loop, subject)
    return figure


def _steps(subject: Subject) -> Array:
    """Return the times at which the limits of the link profile are drawn [s]."""
    return np.linspace(0.0, subject.flight.duration, 600)


def _limits(subject: Subject) -> list[Array]:
    """Return the limits of uplink and downlink [ms], each of shape (2, n), at n `_steps`."""
    return [bounds(subject, _steps(subject), uplink=uplink) for uplink in (True, False)]


def draw_loop(axes: Axes, subject: Subject) -> None:
    """Draw the loop delay of each echo, cloud's estimate of it, and both directions' limits."""
    flight, time, total = subject.flight, _steps(subject), np.sum(_limits(subject), axis=0)
    echoes = round_trips(flight)
    time_of = flight.seconds(echoes["stamp_ns"])
    dots(axes, time_of, echoes["loop_delay"] * 1e3, style.SKY, "loop delay")
    horizon = flight.control["horizon"] * 1e3
    axes.plot(subject.times, horizon, color=style.BLACK, label="estimate", zorder=4)
    _fill(axes, time, total, "profile")
    mean = total.mean(axis=0)
    axes.plot(time, mean, color=style.GREEN, lw=0.8, ls="--", label="mean", zorder=3)
    _finish_delay(axes, subject, "loop delay (ms)")


def _fill(axes: Axes, time: Array, limits: Array, label: str) -> None:
    """Draw the `limits` of a profile [ms], shape (2, n), at each `time` [s], shape (n,)."""
    axes.fill_between(time, *limits, color=style.LIGHT, lw=0, label=label, zorder=1)


def _finish_delay(axes: Axes, subject: Subject, label: str) -> None:
    """Complete a panel of delays; its axis leaves out what is far above the others."""
    drawn = np.concatenate([np.zeros(1), *(line.get_ydata() for line in axes.lines)])
    axes.set_ylim(0.0, max(MARGIN * float(np.nanpercentile(drawn, 99.5)), 1.0))
    _finish(axes, subject, label)


def _finish(axes: Axes, subject: Subject, label: str) -> None:
    """Complete a panel over time: marks of events, labels of the axes, legend."""
    mark_events(axes, subject)
    time_axis(axes, subject)
    axes.set_ylabel(label)
    legend_above(axes)


def time_axis(axes: Axes, subject: Subject) -> None:
    """Let the axis along x have the time of the flight."""
    axes.set_xlim(0.0, max(subject.flight.duration, 1e-3))
    axes.set_xlabel(TIME)


ODOM_ALT = "Line plots of the position per axis over time: reference, measured, estimated."
ODOM = (
    "Position per axis, as cloud knew it. Reference: the setpoint that the controller tracks. "
    "Measured: the newest odometry that had arrived. Estimated: the prediction from which the "
    "command was computed. The panel at the right enlarges the largest step of the reference."
)
ZOOM, BEFORE = 1.2, 0.1
"""Duration of the part that is enlarged, and how long before the step it begins [s]."""
STEP_MIN = 0.2
"""Smallest step of the reference that is enlarged [m]."""
LINES: dict[str, dict[str, Any]] = {
    "setpoint": dict(label="reference", color=style.BLACK, ls="--", drawstyle="steps-post"),
    "measured": dict(label="measured", color=style.ORANGE, lw=1.8),
    "position": dict(label="estimated", color=style.BLUE),
}
"""Column of the control loop -> style of its line."""


def draw_odom(subject: Subject) -> Figure:
    """Draw reference, measured and estimated position, one panel per axis.

    In a wide figure, a panel at the right enlarges the largest step of the reference.
    """
    names = "xy" if subject.shapes.planar else "xyz"
    step = _largest_step(subject, len(names)) if subject.look.width >= style.NARROW else None
    figure = new_figure(1.4 * len(names), subject.look.width)
    mosaic: list[Any] = [[name, "step"] if step else [name] for name in names]
    panels = figure.subplot_mosaic(mosaic, width_ratios=(4.0, 1.2) if step else None)
    rows = [panels[name] for name in names]
    for index, axes in enumerate(rows):
        panel(axes, "abc"[index])
        draw_position(axes, subject, index)
    for axes in rows[:-1]:
        axes.sharex(rows[-1])
        axes.tick_params(labelbottom=False)
    time_axis(rows[-1], subject)
    legend_above(rows[0])
    figure.align_ylabels(rows)
    if step:
        index, begin = step
        panel(panels["step"], "abcd"[len(names)], f"step of ${names[index]}$ (m)")
        _draw_step(panels["step"], subject, index, begin)
    return figure


def draw_position(axes: Axes, subject: Subject, index: int) -> None:
    """Draw a panel of the position along one axis of the world, 0 to 2."""
    _draw_position(axes, subject, index)
    mark_events(axes, subject)
    axes.set_ylabel(f"${'xyz'[index]}$ (m)")
    axes.margins(y=0.12)


def _draw_position(axes: Axes, subject: Subject, index: int, rows: Any = slice(None)) -> None:
    """Draw `rows` of the position along one axis of the world, 0 to 2."""
    for column, look in LINES.items():
        axes.plot(subject.times[rows], subject.flight.control[column][rows, index], **look)


def _largest_step(subject: Subject, count: int) -> tuple[int, float] | None:
    """Find the largest step of the reference along the first `count` axes of the world.

    Return its axis, and when the part that is enlarged begins [s]; None if there is no step.
    """
    control = subject.flight.control
    jumps = np.abs(np.diff(control["setpoint"][:, :count], axis=0))
    if jumps.max(initial=0.0) <= STEP_MIN:
        return None
    row, index = divmod(int(jumps.argmax()), count)
    return index, float(subject.times[row + 1]) - BEFORE


def _draw_step(axes: Axes, subject: Subject, index: int, begin: float) -> None:
    """Enlarge the position along an axis from `begin` [s] on."""
    rows = (subject.times >= begin) & (subject.times <= begin + ZOOM)
    _draw_position(axes, subject, index, rows)
    axes.locator_params(nbins=4, axis="x")
    axes.set_xlabel("time (s)")


ERROR_ALT = "Two line plots over time: distance to the setpoint, and the error of the estimate."
ERROR = (
    "Errors. (a) Distance from the reference to the measured and to the estimated position, as in "
    "the paper. The distance to the next waypoint dominates both curves; a lower estimated curve "
    "says nothing about how accurate the estimate is. (b) Accuracy of the estimate: distance from "
    "the position estimated for each command to the true position when the command was applied. "
    "Each dot is one command. RMS values in the legends are over the whole flight."
)


def draw_error(subject: Subject) -> Figure:
    """Draw the distance to the setpoint and, in a second panel, the errors of the estimates."""
    figure, (tracking, accuracy) = subject.look.two_panels()
    flight = subject.flight
    panel(tracking, "a")
    draw_tracking(tracking, subject)

    panel(accuracy, "b")
    _, instants_ns, error = prediction_errors(flight)
    time, distance = flight.seconds(instants_ns), np.linalg.norm(error, axis=1) * 1e3
    dots(accuracy, time, distance, style.SKY, f"each command{_rms(error, 'mm', 1e3)}")
    accuracy.set_ylim(bottom=0.0)
    _finish(accuracy, subject, "distance to truth (mm)")
    return figure


def draw_tracking(axes: Axes, subject: Subject) -> None:
    """Draw the distances from the reference to the measured and to the estimated position."""
    for column in ("measured", "position"):
        error = tracking_errors(subject.flight, subject.flight.control[column])
        look = LINES[column] | {"label": f"{LINES[column]['label']}{_rms(error, 'm', 1.0)}"}
        axes.plot(subject.times, np.linalg.norm(error, axis=1), **look)
    axes.set_ylim(bottom=0.0)
    _finish(axes, subject, "distance to reference (m)")


def _rms(error: Array, unit: str, scale: float) -> str:
    value = rms(error)
    return "" if value is None else f" (RMS {value * scale:.3g} {unit})"
