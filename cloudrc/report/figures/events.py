"""What happened to link and guard: HOLD, blackouts and link changes marked behind the curves."""

from __future__ import annotations

from typing import TypeAlias

from matplotlib.axes import Axes

from cloudrc.metrics._hold import holds
from cloudrc.report.figures.style import GREY, VERMILION
from cloudrc.report.figures.subject import Subject

Span: TypeAlias = tuple[float, float]
HATCH = "#b0b0b0"
LEGEND = (
    " Behind the curves, red: the guard flew by itself (HOLD); hatched: the link was silent; "
    "dotted: the link changed."
)


def legend(subject: Subject) -> str:
    """Say what the marks mean, or nothing if there are none."""
    return LEGEND if any(_marks(subject)) else ""


def mark_events(axes: Axes, subject: Subject) -> None:
    """Shade HOLD, hatch blackouts and draw a line at each change of the link."""
    held, silent, changed = _marks(subject)
    for begin, end in held:
        axes.axvspan(begin, end, color=VERMILION, alpha=0.15, lw=0, zorder=0.5)
    for begin, end in silent:
        axes.axvspan(begin, end, fc="none", ec=HATCH, hatch="////", lw=0, zorder=0.6)
    for instant in changed:
        axes.axvline(instant, color=GREY, lw=0.7, ls=(0, (1, 2)))


def _marks(subject: Subject) -> tuple[list[Span], list[Span], list[float]]:
    """List HOLD, blackouts and changes of the link during the flight [s since its start]."""
    flight, directions = subject.flight, (subject.uplink, subject.downlink)
    held = [(flight.seconds(start), flight.seconds(end)) for start, end in holds(flight)]
    blackouts = {
        (b.start_s + subject.link_start, b.start_s + b.duration_s + subject.link_start)
        for direction in directions
        for b in direction.blackouts
    }
    silent = [span for span in sorted(blackouts) if span[0] < subject.duration and span[1] > 0]
    instants = {c.at_s + subject.link_start for direction in directions for c in direction.changes}
    return held, silent, [instant for instant in sorted(instants) if 0 < instant < subject.duration]
