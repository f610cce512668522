"""Draw the figure of the position: reference, measured and estimated, one panel per axis."""

from __future__ import annotations

from matplotlib.figure import Figure

from cloudrc.report.figures.marks import legend, mark_events
from cloudrc.report.figures.style import (
    ESTIMATED,
    MEASURED,
    PAGE,
    REFERENCE,
    Subject,
    legend_above,
    new_figure,
    panel,
    time_axis,
)

ALT = "Three line plots of the x, y and z position over time: reference, measured, estimated."
CAPTION = (
    "Position per axis, as cloud knew it. Reference: the setpoint that the controller tracks. "
    "Measured: the newest odometry that had arrived. Estimated: the prediction from which the "
    "command was computed."
)


def caption(subject: Subject) -> str:
    """Write the caption."""
    return CAPTION + legend(subject)


def draw(subject: Subject) -> Figure:
    """Draw the three panels with a common time axis."""
    figure = new_figure(PAGE, 4.2)
    control = subject.flight.control
    time = subject.flight.seconds(control["stamp_ns"])
    rows = figure.subplots(3, 1, sharex=True)
    for index, (axes, name) in enumerate(zip(rows, "xyz", strict=True)):
        panel(axes, "abc"[index])
        setpoint = control["setpoint"][:, index]
        axes.plot(
            time, setpoint, color=REFERENCE, ls="--", drawstyle="steps-post", label="reference"
        )
        axes.plot(time, control["measured"][:, index], color=MEASURED, lw=1.8, label="measured")
        axes.plot(time, control["position"][:, index], color=ESTIMATED, label="estimated")
        mark_events(axes, subject)
        axes.set_ylabel(f"${name}$ (m)")
        axes.margins(y=0.12)
    time_axis(rows[-1], subject.duration)
    legend_above(rows[0], 3)
    figure.align_ylabels(rows)
    return figure
