"""Mark HOLD, blackouts and link changes in figures; compute the delays that the profile allows.

A span is an interval with one link profile. Each change recorded in flight ends a span and begins
the next span. Within a span the profile follows its own time line.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from itertools import pairwise
from math import inf, isnan
from pathlib import Path
from typing import TypeAlias

import numpy as np
from matplotlib.axes import Axes

from cloudrc.config.schema import Direction
from cloudrc.errors import BadInputError
from cloudrc.link.profile import Change, DirectionProfile, Timeline
from cloudrc.link.traces import read_trace
from cloudrc.metrics.flight import Array
from cloudrc.metrics.mission import holds
from cloudrc.report.figures.style import GREY, PURPLE, VERMILION, Subject


@dataclass(frozen=True, slots=True)
class Band:
    """Configured delay over time, in n steps.

    Attributes:
        time: Start of each step, since the start of the link [s], shape (n,).
        low: Delay minus jitter, not below 0 [s], shape (n,).
        high: Delay plus jitter [s], shape (n,).
        period: Time after which the steps begin again [s]; infinite if they do not.
    """

    time: Array
    low: Array
    high: Array
    period: float


def band(direction: Direction) -> Band | None:
    """Compute the band of delays that a link profile sets.

    The band is delay plus and minus jitter. For uniform jitter the band contains all delays; for
    other distributions it has a half-width of one standard deviation.

    Returns:
        The band; None if the delays come from a trace that no longer exists.
    """
    try:
        trace = read_trace(Path(direction.trace)) if direction.trace else None
    except BadInputError:
        return None
    profile = DirectionProfile(
        delay=direction.delay_ms * 1e-3,
        jitter=direction.jitter_ms * 1e-3,
        changes=tuple(
            Change(change.at_s, _seconds(change.delay_ms), _seconds(change.jitter_ms))
            for change in direction.changes
        ),
        trace=replace(trace, loop=direction.loop) if trace else None,
    )
    timeline = Timeline(profile)
    delay = np.array([piece.delay_ns * 1e-9 for piece in timeline.pieces])
    jitter = np.array([piece.jitter for piece in timeline.pieces])
    period = inf if timeline.period_ns is None else timeline.period_ns * 1e-9
    time = np.array(timeline.pass_ns) * 1e-9
    return Band(time, np.maximum(delay - jitter, 0.0), delay + jitter, period)


def bounds_at(steps: Band, time: Array) -> tuple[Array, Array]:
    """Look up the lower and upper bound [s] at each `time` [s] since the start of the link."""
    inside = np.where(time > 0.0, np.mod(time, steps.period), time)
    rows = np.maximum(np.searchsorted(steps.time, inside, side="right") - 1, 0)
    return steps.low[rows], steps.high[rows]


def _seconds(value_ms: float | None) -> float | None:
    return None if value_ms is None else value_ms * 1e-3


SAME_CHANGE = 0.05
"""Two records less than this time apart describe the same change [s]."""


@dataclass(frozen=True, slots=True)
class Span:
    """An interval in which a direction has one link profile.

    Attributes:
        begin: Begin, as time since the start of the flight [s]; -inf if the span began before.
        end: End, likewise [s]; inf if the span lasts to the end of the flight.
        origin: Start of the profile's time line, likewise [s].
        direction: The link profile of this direction.
        cause: Cause of the change; "" if the link started with this profile.
    """

    begin: float
    end: float
    origin: float
    direction: Direction
    cause: str


def spans(subject: Subject, *, uplink: bool) -> list[Span]:
    """List the spans of a direction, in the order of time."""
    configured = subject.uplink if uplink else subject.downlink
    found = [Span(-inf, inf, subject.link_start, configured, "")]
    for begin, origin, direction, cause in _changes(subject, uplink):
        last = found[-1]
        if not cause and isnan(origin) and direction == last.direction:
            continue  # the link started as configured
        if abs(begin - last.begin) < SAME_CHANGE:
            continue  # a repeated record
        origin = last.origin if isnan(origin) else origin
        found.append(Span(begin, inf, origin, direction, cause))
    ends = [after.begin for _, after in pairwise(found)] + [inf]
    return [
        Span(span.begin, end, span.origin, span.direction, span.cause)
        for span, end in zip(found, ends, strict=True)
        if span.begin < end
    ]


def bounds(subject: Subject, time: Array, *, uplink: bool) -> tuple[Array, Array] | None:
    """Look up the delays that the link profile sets for a direction.

    Args:
        subject: The flight.
        time: Time since the start of the flight [s], shape (n,).
        uplink: True for the uplink, False for the downlink.

    Returns:
        Lower and upper bound [s], shape (n,), NaN where a trace no longer exists; None if all
        values are NaN.
    """
    low, high = np.full(len(time), np.nan), np.full(len(time), np.nan)
    for span in spans(subject, uplink=uplink):
        steps = band(span.direction)
        rows = (time >= span.begin) & (time < span.end)
        if steps is not None and rows.any():
            low[rows], high[rows] = bounds_at(steps, time[rows] - span.origin)
    return None if np.isnan(low).all() and len(time) else (low, high)


def set_in_flight(subject: Subject) -> list[tuple[float, str]]:
    """List the changes of the link made in flight: time since its start [s], and cause."""
    found: list[tuple[float, str]] = []
    both = [span for uplink in (True, False) for span in spans(subject, uplink=uplink)]
    for span in sorted(both, key=lambda span: span.begin):
        if not span.cause or not 0.0 < span.begin < subject.duration:
            continue
        # Both directions record the same change, at most 0.1 s apart.
        if not found or found[-1][1] != span.cause or span.begin - found[-1][0] > 1.0:
            found.append((span.begin, span.cause))
    return found


def _changes(subject: Subject, uplink: bool) -> list[tuple[float, float, Direction, str]]:
    """Read the recorded changes: begin, start of the time line, link profile, cause."""
    table = subject.flight.recording["/link"]
    found = []
    for row in np.flatnonzero(table["uplink"] == uplink):
        stamp = float(subject.flight.seconds(table["stamp_ns"][row]))
        try:
            direction = Direction.model_validate_json(str(table["conditions"][row]))
        except ValueError:  # recorded by another version
            continue
        begin, origin = stamp - table["age"][row], stamp - table["time_line"][row]
        found.append((float(begin), float(origin), direction, str(table["cause"][row])))
    return sorted(found, key=lambda change: change[0])


Interval: TypeAlias = tuple[float, float]
HATCH = "#b0b0b0"
LABEL_WIDTH = 0.05
"""Width of a number beside a triangle, as a share of the narrowest panel's time axis [1]."""
ROW_HEIGHT = 8
"""Distance between two rows of numbers [points]."""
ROWS = 8
"""Number of rows of numbers for which a panel has room [1]."""
LEGEND = (
    " Behind the curves: red, the guard was in HOLD; hatched, a blackout of the link; dotted, a "
    "change of the link by its profile."
)


def legend(subject: Subject) -> str:
    """Explain the marks in words; "" if there are none."""
    changes = [
        f"{number}: {cause}, at {begin:.1f} s"
        for number, (begin, cause) in enumerate(set_in_flight(subject), start=1)
    ]
    text = LEGEND if any(_marks(subject)) else ""
    if changes:
        text += f" Triangles: the link was set in flight ({'; '.join(changes)})."
    return text


def mark_events(axes: Axes, subject: Subject) -> None:
    """Shade HOLD, hatch blackouts and draw a line at each change of the link."""
    held, silent, changed = _marks(subject)
    for begin, end in held:
        axes.axvspan(begin, end, color=VERMILION, alpha=0.15, lw=0, zorder=0.5)
    for begin, end in silent:
        axes.axvspan(begin, end, fc="none", ec=HATCH, hatch="////", lw=0, zorder=0.6)
    for instant in changed:
        axes.axvline(instant, color=GREY, lw=0.7, ls=(0, (1, 2)))
    instants = [instant for instant, _ in set_in_flight(subject)]
    rows = _rows(instants, LABEL_WIDTH * subject.duration)
    for number, (instant, row) in enumerate(zip(instants, rows, strict=True), start=1):
        _mark_set(axes, instant, number, row)


def _rows(instants: list[float], width: float) -> Iterator[int]:
    """Choose the row of each label, from the top, so that labels do not overlap.

    Args:
        instants: Start of each label, rising [s].
        width: Width of a label [s].
    """
    last = [-inf] * ROWS
    for instant in instants:
        free = (row for row, before in enumerate(last) if instant - before >= width)
        row = next(free, last.index(min(last)))
        last[row] = instant
        yield row


def _mark_set(axes: Axes, instant: float, number: int, row: int) -> None:
    """Mark a change by the user at an instant [s]: a line, a triangle on top, and its number."""
    place = axes.get_xaxis_transform()
    axes.axvline(instant, color=PURPLE, lw=0.8, zorder=2.5)
    axes.plot(instant, 1.0, "v", ms=6.5, mew=0, color=PURPLE, transform=place, clip_on=False)
    axes.annotate(
        str(number),
        (instant, 1.0),
        (3.5, -9 - ROW_HEIGHT * row),
        xycoords=place,
        textcoords="offset points",
        fontsize=7.0,
        color=PURPLE,
        bbox={"fc": "white", "ec": "none", "pad": 0.5, "alpha": 0.8},
        zorder=6,
    )


def _marks(subject: Subject) -> tuple[list[Interval], list[Interval], list[float]]:
    """List HOLD, blackouts and changes by the profile during the flight [s since its start]."""
    flight, duration = subject.flight, subject.duration
    held = [(flight.seconds(start), flight.seconds(end)) for start, end in holds(flight)]
    blackouts: set[Interval] = set()
    instants: set[float] = set()
    for span in (one for uplink in (True, False) for one in spans(subject, uplink=uplink)):
        for blackout in span.direction.blackouts:
            begin = blackout.start_s + span.origin
            cut = max(begin, span.begin), min(begin + blackout.duration_s, span.end)
            if cut[0] < min(cut[1], duration) and cut[1] > 0:
                blackouts.add(cut)
        changes = (change.at_s + span.origin for change in span.direction.changes)
        instants |= {at for at in changes if span.begin <= at < span.end and 0 < at < duration}
    return held, sorted(blackouts), sorted(instants)
