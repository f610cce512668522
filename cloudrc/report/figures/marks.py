"""What happened to link and guard: HOLD, blackouts and link changes marked behind the curves.

What the link was asked to be, over time: a direction's conditions become a band of delays.

What the link was asked to be in the course of a flight: the experiment's, then what was set.

Each change that was recorded in flight ends one span and begins the next; within a span a
direction's own time line runs.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from itertools import pairwise
from math import inf, isnan
from pathlib import Path
from typing import TypeAlias

import numpy as np
from matplotlib.axes import Axes

from cloudrc.config.schema import Direction
from cloudrc.errors import BadInputError
from cloudrc.link.traces import read_trace
from cloudrc.metrics.flight import Array
from cloudrc.metrics.mission import holds
from cloudrc.report.figures.style import GREY, PURPLE, VERMILION, Subject


@dataclass(frozen=True, slots=True)
class Band:
    """Delay asked for, in steps; n rows.

    Attributes:
        time: When each step begins, since the link came up [s], shape (n,).
        low: Delay minus jitter, not below 0 [s], shape (n,).
        high: Delay plus jitter [s], shape (n,).
    """

    time: Array
    low: Array
    high: Array


def band(direction: Direction) -> Band | None:
    """Work out the delays that a direction was asked to have.

    For uniform jitter these are the bounds, for the others one standard deviation each way.

    Returns:
        None if the delays come from a trace that is no longer there.
    """
    try:
        steps = _traced(Path(direction.trace)) if direction.trace else [(0.0, direction.delay_ms)]
    except BadInputError:
        return None
    delay, jitter = steps[0][1], direction.jitter_ms
    changes = {} if direction.trace else {c.at_s: c.delay_ms for c in direction.changes}
    delays = {**dict(steps), **{at: ms for at, ms in changes.items() if ms is not None}}
    jitters = {c.at_s: c.jitter_ms for c in direction.changes if c.jitter_ms is not None}
    rows = []
    for at in sorted({*delays, *jitters}):
        delay, jitter = delays.get(at, delay), jitters.get(at, jitter)
        rows.append((at, max(delay - jitter, 0.0) * 1e-3, (delay + jitter) * 1e-3))
    time, low, high = np.array(rows).T
    return Band(time, low, high)


def at(steps: Band, time: Array) -> tuple[Array, Array]:
    """Look up the lower and upper bound [s] at each `time` [s] since the link came up."""
    rows = np.maximum(np.searchsorted(steps.time, time, side="right") - 1, 0)
    return steps.low[rows], steps.high[rows]


def _traced(path: Path) -> list[tuple[float, float]]:
    """Read instants [s] and delays [ms] of a trace; the first row also holds before its time."""
    trace = read_trace(path)
    delays = [delay * 1e3 for delay in trace.delays]
    return [(0.0, delays[0]), *zip(trace.times, delays, strict=True)]


SAME = 0.05
"""Notes of one change that differ by less are of the same [s]."""


@dataclass(frozen=True, slots=True)
class Span:
    """A time in which a direction was asked to be one thing.

    Attributes:
        begin: Since the start of the flight [s]; -inf: it was so before.
        end: Likewise; inf: to the end.
        origin: When its time line began, likewise [s].
        direction: Its conditions.
        cause: Who changed it, in words; "" if it came up so.
    """

    begin: float
    end: float
    origin: float
    direction: Direction
    cause: str


def spans(subject: Subject, *, uplink: bool) -> list[Span]:
    """List what a direction was asked to be, in order."""
    configured = subject.uplink if uplink else subject.downlink
    found = [Span(-inf, inf, subject.link_start, configured, "")]
    for begin, origin, direction, cause in _changes(subject, uplink):
        last = found[-1]
        if not cause and isnan(origin) and direction == last.direction:
            continue  # it came up as configured
        if abs(begin - last.begin) < SAME:
            continue  # noted again
        origin = last.origin if isnan(origin) else origin
        found.append(Span(begin, inf, origin, direction, cause))
    ends = [after.begin for _, after in pairwise(found)] + [inf]
    return [
        Span(span.begin, end, span.origin, span.direction, span.cause)
        for span, end in zip(found, ends, strict=True)
        if span.begin < end
    ]


def bounds(subject: Subject, time: Array, *, uplink: bool) -> tuple[Array, Array] | None:
    """Look up the delays that a direction was asked to have.

    Args:
        subject: The flight.
        time: Since its start [s], shape (n,).
        uplink: Which direction.

    Returns:
        Lower and upper bound [s], shape (n,), NaN where a trace is no longer there; None if all
        of it is.
    """
    low, high = np.full(len(time), np.nan), np.full(len(time), np.nan)
    for span in spans(subject, uplink=uplink):
        steps = band(span.direction)
        rows = (time >= span.begin) & (time < span.end)
        if steps is not None and rows.any():
            low[rows], high[rows] = at(steps, time[rows] - span.origin)
    return None if np.isnan(low).all() and len(time) else (low, high)


def set_in_flight(subject: Subject) -> list[tuple[float, str]]:
    """List when the link was set during the flight [s since its start], and to what."""
    found: list[tuple[float, str]] = []
    both = [span for uplink in (True, False) for span in spans(subject, uplink=uplink)]
    for span in sorted(both, key=lambda span: span.begin):
        if not span.cause or not 0.0 < span.begin < subject.duration:
            continue
        # Both directions note one change, a tenth of a second apart at most.
        if not found or found[-1][1] != span.cause or span.begin - found[-1][0] > 1.0:
            found.append((span.begin, span.cause))
    return found


def _changes(subject: Subject, uplink: bool) -> list[tuple[float, float, Direction, str]]:
    """Read the recorded changes: when, since when the time line counts, what, why."""
    table = subject.flight.recording["/link"]
    found = []
    for row in np.flatnonzero(table["uplink"] == uplink):
        stamp = float(subject.flight.seconds(table["stamp_ns"][row]))
        try:
            direction = Direction.model_validate_json(str(table["conditions"][row]))
        except ValueError:  # of another version
            continue
        begin, origin = stamp - table["age"][row], stamp - table["time_line"][row]
        found.append((float(begin), float(origin), direction, str(table["cause"][row])))
    return sorted(found, key=lambda change: change[0])


Interval: TypeAlias = tuple[float, float]
HATCH = "#b0b0b0"
LABEL_WIDTH = 0.05
"""Of a number beside a triangle, as a part of the narrowest panel's time axis [1]."""
ROW_HEIGHT = 8
"""Between two rows of numbers [points]."""
ROWS = 8
"""Of numbers, that a panel has room for."""
LEGEND = (
    " Behind the curves, red: the guard flew by itself (HOLD); hatched: the link was silent; "
    "dotted: the link changed."
)


def legend(subject: Subject) -> str:
    """Say what the marks mean, or nothing if there are none."""
    changes = [
        f"{number}: {cause}, at {begin:.1f} s"
        for number, (begin, cause) in enumerate(set_in_flight(subject), start=1)
    ]
    said = LEGEND if any(_marks(subject)) else ""
    return said + (
        f" Triangles: the link was set in flight ({'; '.join(changes)})." * bool(changes)
    )


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
    """Choose the row of each label, from above, so that none is printed over another.

    Args:
        instants: Where each begins, rising [s].
        width: Of a label [s].
    """
    last = [-inf] * ROWS
    for instant in instants:
        free = (row for row, before in enumerate(last) if instant - before >= width)
        row = next(free, last.index(min(last)))
        last[row] = instant
        yield row


def _mark_set(axes: Axes, instant: float, number: int, row: int) -> None:
    """Mark at [s] that the link was set by hand: a line, a triangle on top, its number in a row."""
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
    """List HOLD, blackouts and changes of the link during the flight [s since its start]."""
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
