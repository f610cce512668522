"""Mark HOLD, blackouts and changes of the link in figures; compute the delays of the link profile.

A span is an interval of a flight with one link profile: `cloudrc link set` ends a span and starts
the next. Within a span, the link follows the time line of the profile.
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
from cloudrc.report.figures import style
from cloudrc.report.figures.labels import free_label
from cloudrc.report.figures.style import Subject

Interval: TypeAlias = tuple[float, float]
SAME_CHANGE = 0.05
"""Two records of one direction describe the same change if their times differ by less [s]."""
SAME_CAUSE = 1.0
"""Records of uplink and downlink describe one change if their times differ by at most this [s]."""
LEGEND = (
    " Behind the curves: red, the guard was in HOLD; hatched, a blackout of the link; dotted, a "
    "change of the link by its profile."
)


def delays_of(direction: Direction) -> Timeline | None:
    """Return a profile's delay and jitter over time; None if its trace file cannot be read."""

    def seconds(milliseconds: float | None) -> float | None:
        return None if milliseconds is None else milliseconds * 1e-3

    changes = tuple(
        Change(change.at_s, seconds(change.delay_ms), seconds(change.jitter_ms))
        for change in direction.changes
    )
    delay, jitter = direction.delay_ms * 1e-3, direction.jitter_ms * 1e-3
    profile = DirectionProfile(delay, jitter, changes=changes)
    if direction.trace:
        try:
            trace = read_trace(Path(direction.trace))
        except BadInputError:
            return None
        profile = replace(profile, trace=replace(trace, loop=direction.loop))
    return Timeline(profile)


def band(delays: Timeline, time: Array) -> tuple[Array, Array]:
    """Compute delay - jitter and delay + jitter [s] at each `time` [s] since the link's start.

    Uniformly distributed delays are all in this band; for other distributions, its half width is
    one standard deviation.
    """
    found = [delays.at(round(instant * 1e9)) for instant in time.tolist()]
    delay = np.array([conditions.delay_ns for conditions in found]) * 1e-9
    jitter = np.array([conditions.jitter for conditions in found])
    return np.maximum(delay - jitter, 0.0), delay + jitter


@dataclass(frozen=True, slots=True)
class Span:
    """An interval with one link profile in one direction; times since the start of the flight."""

    begin: float  # [s]; -inf for the profile at the start of the flight
    origin: float  # start of the profile's time line [s]
    direction: Direction
    cause: str  # cause of the change; "" if the link started with this profile
    end: float = inf  # [s]; inf if the span lasts to the end of the flight


def spans(subject: Subject, *, uplink: bool) -> list[Span]:
    """List the times between two changes of one link direction, each with its profile."""
    configured = subject.uplink if uplink else subject.downlink
    found = [Span(-inf, subject.link_start, configured, "")]
    for span in sorted(_changes(subject, uplink), key=lambda span: span.begin):
        last = found[-1]
        if not span.cause and isnan(span.origin) and span.direction == last.direction:
            continue  # the link started as configured
        if span.begin - last.begin < SAME_CHANGE:
            continue  # a repeated record
        found.append(replace(span, origin=last.origin) if isnan(span.origin) else span)
    ends = [after.begin for _, after in pairwise(found)] + [inf]
    ended = [replace(span, end=end) for span, end in zip(found, ends, strict=True)]
    return [span for span in ended if span.begin < span.end]


def _changes(subject: Subject, uplink: bool) -> Iterator[Span]:
    table = subject.flight.recording["/link"]
    for row in np.flatnonzero(table["uplink"] == uplink):
        stamp = float(subject.flight.seconds(table["stamp_ns"][row]))
        try:
            direction = Direction.model_validate_json(str(table["conditions"][row]))
        except ValueError:  # another version of cloudrc has recorded this flight
            continue
        begin, origin = stamp - table["age"][row], stamp - table["time_line"][row]
        yield Span(float(begin), float(origin), direction, str(table["cause"][row]))


def bounds(subject: Subject, time: Array, *, uplink: bool) -> tuple[Array, Array] | None:
    """Compute the band of delays of the link profile at each `time` [s] since the flight's start.

    Return its lower and upper end [s], NaN where the file of a trace is missing; None if all are.
    """
    low, high = np.full(len(time), np.nan), np.full(len(time), np.nan)
    for span in spans(subject, uplink=uplink):
        delays = delays_of(span.direction)
        rows = (time >= span.begin) & (time < span.end)
        if delays is not None:
            low[rows], high[rows] = band(delays, time[rows] - span.origin)
    return None if np.isnan(low).all() else (low, high)


def set_in_flight(subject: Subject) -> list[tuple[float, str]]:
    """List the changes by `cloudrc link set`: time since the start of the flight [s], and cause."""
    found: list[tuple[float, str]] = []
    for span in sorted(_all_spans(subject), key=lambda span: span.begin):
        if not span.cause or not 0.0 < span.begin < subject.duration:
            continue
        if not found or found[-1][1] != span.cause or span.begin - found[-1][0] > SAME_CAUSE:
            found.append((span.begin, span.cause))
    return found


def _all_spans(subject: Subject) -> list[Span]:
    return [span for uplink in (True, False) for span in spans(subject, uplink=uplink)]


def legend(subject: Subject) -> str:
    """Describe the marks of a flight for a caption; "" if there are no marks."""
    changes = [
        f"{number}: {cause}, at {begin:.1f} s"
        for number, (begin, cause) in enumerate(set_in_flight(subject), start=1)
    ]
    text = LEGEND if any(_marks(subject)) else ""
    if changes:
        text += f" Triangles: the link was set in flight ({'; '.join(changes)})."
    return text


def mark_events(axes: Axes, subject: Subject) -> None:
    """Draw the marks: HOLD shaded, blackouts hatched, changes of the link as vertical lines."""
    held, silent, changed = _marks(subject)
    for begin, end in held:
        axes.axvspan(begin, end, color=style.VERMILION, alpha=0.15, lw=0, zorder=0.5)
    for begin, end in silent:
        axes.axvspan(begin, end, fc="none", ec="#b0b0b0", hatch="////", lw=0, zorder=0.6)
    for instant in changed:
        axes.axvline(instant, color=style.GREY, lw=0.7, ls=(0, (1, 2)))
    place, colour = axes.get_xaxis_transform(), style.PURPLE
    for number, (instant, _) in enumerate(set_in_flight(subject)):
        axes.axvline(instant, color=colour, lw=0.8, zorder=2.5)
        axes.plot(instant, 1.0, "v", ms=6.5, mew=0, color=colour, transform=place, clip_on=False)
        free_label(axes, str(number + 1), (instant, 1.0), xycoords=place, color=colour)


def _marks(subject: Subject) -> tuple[list[Interval], list[Interval], list[float]]:
    """List HOLDs, blackouts and changes by the profile, in seconds since the flight's start."""
    flight, duration = subject.flight, subject.duration
    held = [(flight.seconds(start), flight.seconds(end)) for start, end in holds(flight)]
    blackouts: set[Interval] = set()
    instants: set[float] = set()
    for span in _all_spans(subject):
        for blackout in span.direction.blackouts:
            begin = blackout.start_s + span.origin
            cut = max(begin, span.begin), min(begin + blackout.duration_s, span.end)
            if cut[0] < min(cut[1], duration) and cut[1] > 0:
                blackouts.add(cut)
        changes = (change.at_s + span.origin for change in span.direction.changes)
        instants |= {at for at in changes if span.begin <= at < span.end and 0 < at < duration}
    return held, sorted(blackouts), sorted(instants)
