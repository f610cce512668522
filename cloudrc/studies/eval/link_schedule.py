# SPDX-License-Identifier: Apache-2.0

"""Say which part of its link's schedule an evaluation has met."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from itertools import pairwise
from typing import Any, NamedTuple

from cloudrc.flight.trials.rows import Row
from cloudrc.gym.links import choose_link
from cloudrc.link.profile import DirectionProfile, LinkSchedule, mean_loss
from cloudrc.studies.eval.setup import BASELINE, EvalSetup

OUTAGE = 0.99
"""Loss from which on a link is out [1]."""
SHOWN = 6
"""Largest number of parts and of events that are told."""


class Span(NamedTuple):
    """A part of a schedule, without the end."""

    begin: float  # [s]
    end: float  # [s]


def find_met(setup: EvalSetup, rows: Sequence[Row]) -> dict[str, Any] | None:
    """Return which part of the schedule the episodes with a network have met, in plain values.

    Return None for a link that does not change.
    """
    choose, _ = choose_link(setup.link, 0)
    link = choose(0, 0, "").profile
    rows = [row for row in rows if row["point"]["executor"] != BASELINE]
    assert setup.step is not None, "an environment that was played has a time step"
    dt = setup.step.seconds
    lines = [LinkSchedule(way) for way in (link.uplink, link.downlink)]
    if not rows or all(line.only() is not None for line in lines):
        return None
    periods = [line.period_ns / 1e9 for line in lines if line.period_ns is not None]
    period = max(periods, default=None)
    met = [
        Span(row["link_start"], row["link_start"] + row["numbers"]["steps"] * dt) for row in rows
    ]
    events = sorted({*_events(link.uplink), *_events(link.downlink)})
    return {
        "period": period,
        "episodes": len(met),
        "longest": max(each.end - each.begin for each in met),
        "met": _union([part for each in met for part in _within(each, period)]),
        "events": [
            {**each._asdict(), "met": sum(_meets(one, each, period) for one in met)}
            for each in events
        ],
    }


def _events(way: DirectionProfile) -> Iterator[Span]:
    """Yield the outages of a direction; without any, its changes, if they are few."""
    line = LinkSchedule(way)
    edges = [*line.pass_ns, line.period_ns or line.pass_ns[-1] + 1_000_000_000]
    spans = [Span(a / 1e9, b / 1e9) for a, b in pairwise(edges)]
    out = [
        span
        for span, each in zip(spans, line.pieces, strict=True)
        if each.blackout or mean_loss(each.loss) >= OUTAGE
    ]
    if out:
        yield from (Span(*each) for each in _union(out))
    elif len(spans) <= SHOWN:
        yield from (Span(each.begin, each.begin) for each in spans[1:])


def _within(met: Span, period: float | None) -> Iterator[Span]:
    """Yield the parts of a schedule that repeats."""
    if period is None:
        yield met
    elif met.end - met.begin >= period:
        yield Span(0.0, period)
    else:
        begin = met.begin % period
        end = begin + met.end - met.begin
        yield Span(begin, min(end, period))
        if end > period:
            yield Span(0.0, end - period)


def _union(spans: Sequence[Span]) -> list[tuple[float, float]]:
    """Return the parts that are in any of the spans, rising."""
    found = list[tuple[float, float]]()
    for begin, end in sorted(spans):
        if found and begin <= found[-1][1] + 1e-9:
            found[-1] = found[-1][0], max(found[-1][1], end)
        else:
            found.append((begin, end))
    return found


def _meets(met: Span, event: Span, period: float | None) -> bool:
    """Return whether an episode meets an event, also in a later pass."""
    begin, end = event
    if period is not None:
        passes = (met.begin - end) // period + 1.0
        begin, end = begin + passes * period, end + passes * period
    return met.begin < end + 1e-12 and begin < met.end


def describe_met(found: Mapping[str, Any]) -> Iterator[str]:
    """Say which part of the schedule was met, and how many episodes met each of its events."""
    period, count = found["period"], found["episodes"]
    parts = [f"{begin:.3g} to {end:.3g} s" for begin, end in found["met"]]
    more = f" and {len(parts) - SHOWN} more parts" * (len(parts) > SHOWN)
    line = "link schedule" if period is None else f"link schedule of {period:g} s"
    yield f"{line}: {', '.join(parts[:SHOWN])}{more} met by {count} episodes"
    for each in found["events"][:SHOWN]:
        length = each["end"] - each["begin"]
        name = f"outage at {each['begin']:g} s ({length:.3g} s)"
        if not length:
            name = f"change at {each['begin']:g} s"
        if each["met"]:
            yield f"{name}: met by {each['met']} of {count} episodes"
        else:
            yield f"no episode met the {name}: the longest has {found['longest']:.1f} s"
