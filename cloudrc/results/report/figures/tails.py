# SPDX-License-Identifier: Apache-2.0

"""Draw the distribution of ages: the share of the time or steps with a higher age, 1 - F(x)."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from itertools import cycle
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from cloudrc.results.metrics.age import tail
from cloudrc.results.metrics.control import ages_at_actuator
from cloudrc.results.metrics.flight import Array
from cloudrc.results.report.figures import style
from cloudrc.results.report.figures.style import COLOURS, DASHES, Subject, legend_above, new_figure

AGE_ALT = "A line plot: the share of the time in which the age of information is above a value."
AGE = (
    "Age of information at the actuator: the age of the odometry behind the command that the robot "
    "follows, and the share of the time with a command in use in which it is higher. A dashed line "
    "is criteria.age_deadline_s."
)


def draw_age(subject: Subject) -> Figure:
    """Draw the distribution of the age of information at the actuator."""
    figure, flight = new_figure(2.6, subject.look.width), subject.flight
    axes, ages = figure.subplots(), ages_at_actuator(flight)
    draw_tails(axes, {"": tail(ages)} if len(ages.low) else {}, flight.criteria.age_deadline_s)
    legend_above(axes)
    axes.set_xlabel("age at the actuator, x (ms)")
    return figure


def draw_tails(
    axes: Axes, lines: Mapping[str, tuple[Array, Array]], limit: float | None, **look: Any
) -> None:
    """Draw a line per name: ages [s], and the share in which the age is above each [1].

    A `limit` [s] is a dashed line. `look` is that of matplotlib for each line.
    """
    styles: Iterable[Any] = zip(lines.items(), cycle(COLOURS), cycle(DASHES))
    least = 1.0
    for (name, (ages, share)), colour, dashes in styles:
        axes.plot(1e3 * ages, share, color=colour, ls=dashes, label=name or "_", **look)
        least = min(least, share[share > 0.0].min(initial=1.0))
    if limit is not None:
        axes.axvline(1e3 * limit, color=style.GREY, lw=0.9, ls=(0, (5, 3)), label="deadline")
    axes.set_yscale("log")
    axes.yaxis.set_major_formatter("{x:g}")
    axes.minorticks_off()
    axes.set_ylim(max(10.0 ** (np.ceil(np.log10(least)) - 1.0), 1e-4), 1.1)
    axes.set_ylabel("P(age > x)")
