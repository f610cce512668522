"""What happened to link and guard: HOLD, blackouts and link changes marked behind the curves."""

from __future__ import annotations

from typing import TypeAlias

from matplotlib.axes import Axes

from cloudrc.metrics._hold import holds
from cloudrc.report.figures.asked import set_in_flight, spans
from cloudrc.report.figures.style import GREY, PURPLE, VERMILION
from cloudrc.report.figures.subject import Subject

Span: TypeAlias = tuple[float, float]
HATCH = "#b0b0b0"
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
    for number, (instant, _) in enumerate(set_in_flight(subject), start=1):
        _mark_set(axes, instant, number)


def _mark_set(axes: Axes, instant: float, number: int) -> None:
    """Mark at [s] that the link was set by hand: a line, and a triangle with its number on top."""
    place = axes.get_xaxis_transform()
    axes.axvline(instant, color=PURPLE, lw=0.8, zorder=2.5)
    axes.plot(instant, 1.0, "v", ms=6.5, mew=0, color=PURPLE, transform=place, clip_on=False)
    axes.annotate(
        str(number),
        (instant, 1.0),
        (3.5, -9),
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
