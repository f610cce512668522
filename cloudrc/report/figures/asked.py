"""What the link was asked to be in the course of a flight: the experiment's, then what was set.

Each change that was recorded in flight ends one span and begins the next; within a span a
direction's own time line runs.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise
from math import inf, isnan

import numpy as np

from cloudrc.config.schema import Direction
from cloudrc.metrics.flight import Array
from cloudrc.report.figures import band
from cloudrc.report.figures.subject import Subject

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
        steps = band.band(span.direction)
        rows = (time >= span.begin) & (time < span.end)
        if steps is not None and rows.any():
            low[rows], high[rows] = band.at(steps, time[rows] - span.origin)
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
