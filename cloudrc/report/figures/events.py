"""What happened to link and guard: HOLD, blackouts and link changes marked behind the curves."""

from __future__ import annotations

from collections.abc import Iterator
from math import inf
from typing import TypeAlias

from matplotlib.axes import Axes

from cloudrc.metrics.mission import holds
from cloudrc.report.figures.asked import set_in_flight, spans
from cloudrc.report.figures.style import GREY, PURPLE, VERMILION
from cloudrc.report.figures.subject import Subject

Span: TypeAlias = tuple[float, float]
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


def _marks(subject: Subject) -> tuple[list[Span], list[Span], list[float]]:
    """List HOLD, blackouts and changes of the link during the flight [s since its start]."""
    flight, duration = subject.flight, subject.duration
    held = [(flight.seconds(start), flight.seconds(end)) for start, end in holds(flight)]
    blackouts: set[Span] = set()
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
