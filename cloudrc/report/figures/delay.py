"""Draw the figure of delays: one-way delay of each datagram, loop delay and estimated delay."""

from __future__ import annotations

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from cloudrc.metrics.control import round_trips
from cloudrc.metrics.flight import Array
from cloudrc.report.figures.marks import bounds, legend, mark_events
from cloudrc.report.figures.style import (
    BLACK,
    DOWNLINK,
    GREEN,
    LIGHT,
    PAGE,
    SKY,
    UPLINK,
    Subject,
    legend_above,
    new_figure,
    panel,
    time_axis,
)

ALT = "Two scatter plots over time: one-way delays, and the loop delay with its estimate."
CAPTION = (
    "Delays. (a) Each dot is the one-way delay of a datagram that arrived, late ones included; the "
    "band is the link profile. (b) Each dot is the loop delay of one echo: the time from a "
    "command's stamp to its echo (the paper's τₙ). The solid line is the delay estimate, over "
    "which the controller predicts. The band is the sum of both directions of the link profile, "
    "the dashed line its mean. Only applied commands have echoes; if the newest command wins, "
    "these are the fast ones, so the loop delay lies below the mean of the profile."
)
MARGIN = 1.25
"""Upper end of the delay axis, divided by the 99.5th percentile of the delays [1]."""


def caption(subject: Subject) -> str:
    """Write the caption."""
    return CAPTION + legend(subject)


def draw(subject: Subject) -> Figure:
    """Draw both panels."""
    figure = new_figure(PAGE, 2.6)
    one_way, loop = figure.subplots(1, 2)
    _draw_one_way(one_way, subject)
    _draw_loop(loop, subject)
    return figure


def _draw_one_way(axes: Axes, subject: Subject) -> None:
    panel(axes, "a")
    shown = []
    for topic, name, colour in (
        ("/uplink_delay", "uplink", UPLINK),
        ("/downlink_delay", "downlink", DOWNLINK),
    ):
        arrivals = subject.flight.during(topic)
        time, delay = subject.flight.seconds(arrivals["stamp_ns"]), arrivals["delay"] * 1e3
        if np.isfinite(delay).any():
            _dots(axes, time, delay, colour, name)
            shown.append(delay)
    if not shown:
        text = "unknown: the two ends\ndo not share a clock"
        axes.text(0.5, 0.5, text, ha="center", va="center", transform=axes.transAxes)
    time = np.linspace(0.0, subject.duration, 600)
    tops: list[Array] = []
    for uplink in (True, False):
        limits = bounds(subject, time, uplink=uplink)
        if limits is not None:
            low, high = limits
            label = "_" if tops else "profile"
            axes.fill_between(time, low * 1e3, high * 1e3, color=LIGHT, lw=0, label=label, zorder=1)
            tops.append(high * 1e3)
    _finish(axes, subject, "one-way delay (ms)", [*shown, *tops])


def _draw_loop(axes: Axes, subject: Subject) -> None:
    panel(axes, "b")
    echoes, control = round_trips(subject.flight), subject.flight.control
    loop_delay = echoes["loop_delay"] * 1e3
    _dots(axes, subject.flight.seconds(echoes["stamp_ns"]), loop_delay, SKY, "loop delay")
    horizon = control["horizon"] * 1e3
    time = subject.flight.seconds(control["stamp_ns"])
    axes.plot(time, horizon, color=BLACK, label="estimate", zorder=4)
    shown = [loop_delay, horizon]
    time = np.linspace(0.0, subject.duration, 600)
    up, down = (bounds(subject, time, uplink=uplink) for uplink in (True, False))
    if up is not None and down is not None:
        low, high = (up[0] + down[0]) * 1e3, (up[1] + down[1]) * 1e3
        axes.fill_between(time, low, high, color=LIGHT, lw=0, label="profile", zorder=1)
        axes.plot(time, (low + high) / 2, color=GREEN, lw=0.8, ls="--", label="mean", zorder=3)
        shown.append(high)
    _finish(axes, subject, "loop delay (ms)", shown)


def _dots(axes: Axes, time: Array, delay: Array, colour: str, name: str) -> None:
    # As pixels inside the SVG file, thousands of dots stay small and fast to display.
    axes.plot(time, delay, ".", ms=1.8, mew=0, color=colour, rasterized=True, zorder=2)
    axes.plot([], [], "o", ms=3.5, mew=0, color=colour, label=name)


def _finish(axes: Axes, subject: Subject, label: str, shown: list[Array]) -> None:
    """Scale the axis so that outliers do not flatten the curves, and write how many are cut off."""
    values = [v[np.isfinite(v)] for v in shown]
    top = max((float(np.percentile(v, 99.5)) for v in values if len(v)), default=1.0) * MARGIN
    top = max(top, 1.0)
    axes.set_ylim(0.0, top)
    above = sum(int((v > top).sum()) for v in values)
    if above:
        axes.text(0.99, 0.97, f"{above} above", ha="right", va="top", transform=axes.transAxes)
    mark_events(axes, subject)
    time_axis(axes, subject.duration)
    axes.set_ylabel(label)
    legend_above(axes, 4)
