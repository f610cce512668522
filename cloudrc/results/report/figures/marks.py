# SPDX-License-Identifier: Apache-2.0

"""Mark the state HOLD and link changes in figures; compute the delays of the link profile.

A link profile describes the conditions of a direction over time; `cloudrc link set` replaces the
profile in flight.
"""

from __future__ import annotations

from math import inf, nan
from typing import NamedTuple

import numpy as np
from matplotlib.axes import Axes

from cloudrc.base.errors import CloudrcError
from cloudrc.config.faults import FaultConfig
from cloudrc.config.profile import DirectionConfig
from cloudrc.link.profile import LinkSchedule
from cloudrc.link.radio import slots_of
from cloudrc.link.traces import link_profile
from cloudrc.results.metrics.flight import Array, rows_of, select
from cloudrc.results.metrics.mission import came_up, holds
from cloudrc.results.report.figures import style
from cloudrc.results.report.figures.style import Subject

SAME_CAUSE = 1.0
"""Records of uplink and downlink describe one change if their times differ by at most this [s]."""
HELD = " Red: the guard was in HOLD."


def delays_of(direction: DirectionConfig) -> LinkSchedule | None:
    """Return a direction's link conditions over time; None if a file for them is unreadable."""
    try:
        return LinkSchedule(link_profile(direction))
    except CloudrcError:
        return None


def radio_span(direction: DirectionConfig, *, uplink: bool) -> tuple[float, float]:
    """Return the shortest and longest delay in a radio, without repetitions [ms]; 0 without one."""
    if direction.radio is None:
        return 0.0, 0.0
    span = slots_of(direction.radio, uplink).span
    return span.least * 1e-6, span.most * 1e-6


def band(
    delays: LinkSchedule, time: Array, radio: tuple[float, float] = (0.0, 0.0)
) -> tuple[Array, Array]:
    """Compute delay - jitter and delay + jitter [ms] at each `time` [s] since the link's start.

    `radio` is the shortest and longest delay in a radio, which add to them [ms]. Both are NaN in
    blackouts. Uniformly distributed delays are all in this band; for other distributions, its half
    width is one standard deviation.
    """
    found = [delays.at(round(instant * 1e9)) for instant in time.tolist()]
    delay = np.array([nan if each.blackout else each.delay_ns * 1e-6 for each in found])
    jitter = np.array([each.jitter * 1e3 for each in found])
    return np.maximum(delay - jitter, 0.0) + radio[0], delay + jitter + radio[1]


class LinkSpan(NamedTuple):
    """Part of a flight in which one direction of the link has one profile.

    It lasts until the next `LinkSpan` begins. Times are in seconds since the start of the flight.
    """

    begin: float  # [s]; -inf for the profile at the start of the flight
    origin: float  # start of the profile's schedule [s]
    direction: DirectionConfig
    cause: str  # cause of the change; "" if the link started with this profile


def parts(subject: Subject, *, uplink: bool) -> list[LinkSpan]:
    """List the profiles that were in force in one direction of the link, the earliest first."""
    recording, seconds = subject.flight.recording, subject.flight.seconds
    start, table = came_up(subject.flight, subject.link_start), recording["/link"]
    origin, at_start = start - subject.link_start, subject.uplink if uplink else subject.downlink
    found = [LinkSpan(-inf, origin, at_start, "")]
    ours = select(table.columns, table["uplink"] == uplink)
    names = "stamp_ns", "age", "time_line", "conditions", "cause"
    for stamp_ns, age, time_line, conditions, cause in rows_of(ours, *names):
        try:
            direction = DirectionConfig.model_validate_json(conditions)
        except ValueError:  # another version of cloudrc has recorded this flight
            continue
        now = seconds(stamp_ns)
        found.append(LinkSpan(now - age, now - time_line, direction, cause))
    return sorted(found, key=lambda part: part.begin)


def bounds(subject: Subject, time: Array, *, uplink: bool) -> Array:
    """Compute delay - jitter and delay + jitter [ms] at each `time` [s] since the flight's start.

    The values, shape (2, n), are those of the profile in force. They are NaN in blackouts, and if
    the file of a trace is missing.
    """
    limits = np.full((2, len(time)), nan)
    found = parts(subject, uplink=uplink)
    newest = np.searchsorted([part.begin for part in found], time, "right") - 1
    for number in np.unique(newest):  # a drag of a slider makes many parts without a time
        direction = found[number].direction
        rows, delays = newest == number, delays_of(direction)
        if delays:
            radio = radio_span(direction, uplink=uplink)
            limits[:, rows] = band(delays, time[rows] - found[number].origin, radio)
    return limits


def set_in_flight(subject: Subject) -> list[tuple[float, str]]:
    """List the changes by `cloudrc link set`: time since the start of the flight [s], and cause."""
    found: list[tuple[float, str]] = []
    both = parts(subject, uplink=True) + parts(subject, uplink=False)
    for part in sorted(both, key=lambda part: part.begin):
        if not part.cause or not 0.0 < part.begin < subject.flight.duration:
            continue
        if not found or found[-1][1] != part.cause or part.begin - found[-1][0] > SAME_CAUSE:
            found.append((part.begin, part.cause))
    return found


def legend(subject: Subject) -> str:
    """Explain the marks in a flight's figures (HOLD, faults, changes of the link); "" if none."""
    changes = [f"{cause}, at {begin:.1f} s" for begin, cause in set_in_flight(subject)]
    text = HELD if holds(subject.flight) else ""
    if subject.faults:
        spans = map(_span, subject.faults)
        text += f" Grey: injected faults ({'; '.join(spans)} since the link came up)."
    if changes:
        text += f" Vertical lines: the link was set in flight ({'; '.join(changes)})."
    return text


def _span(fault: FaultConfig) -> str:
    until = f" to {fault.end:g}" if fault.length else ""
    return f"{fault.kind}, {fault.at_s:g}{until} s"


def mark_events(axes: Axes, subject: Subject) -> None:
    """Draw the marks: HOLD and faults shaded, a vertical line for each change of the link."""
    start = came_up(subject.flight, subject.link_start)
    for fault in subject.faults:
        span = start + fault.at_s, start + fault.end
        edge = 0.0 if fault.length else 1.2  # a step of a clock is a line
        axes.axvspan(*span, color=style.GREY, alpha=0.25, lw=edge, zorder=0.4)
    for begin, end in map(subject.flight.seconds, np.reshape(holds(subject.flight), (-1, 2))):
        axes.axvspan(begin, end, color=style.VERMILION, alpha=0.15, lw=0, zorder=0.5)
    for instant, _ in set_in_flight(subject):
        axes.axvline(instant, color=style.PURPLE, lw=1.2, zorder=2.5)
