"""A failing schedule goes in, the smallest one that fails in the same way comes out."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import replace

from cloudrc.faults.schedule import Event, Schedule

Fails = Callable[[Schedule], bool]


def shrink(schedule: Schedule, fails: Fails) -> Schedule:
    """Take out faults, then simplify what is left, as long as it still fails.

    Source: A. Zeller, R. Hildebrandt, Simplifying and isolating failure-inducing input, IEEE TSE
    28(2), 2002: ddmin, on the list of faults.

    Args:
        schedule: That fails.
        fails: Whether a schedule fails in the same way.
    """
    schedule = replace(schedule, events=_ddmin(schedule, fails))
    changed = True
    while changed:
        changed = False
        for simpler in _simpler(schedule):
            if simpler != schedule and fails(simpler):
                schedule, changed = simpler, True
                break
    return schedule


def _ddmin(schedule: Schedule, fails: Fails) -> tuple[Event, ...]:
    events, parts = schedule.events, 2
    while len(events) >= 2:
        size = -(-len(events) // parts)
        rests = [events[:at] + events[at + size :] for at in range(0, len(events), size)]
        rest = next((r for r in rests if fails(replace(schedule, events=r))), None)
        if rest is not None:
            events, parts = rest, max(parts - 1, 2)
        elif size == 1:
            break
        else:
            parts = min(2 * parts, len(events))
    return events


def _simpler(schedule: Schedule) -> Iterator[Schedule]:
    """Schedules with one thing less."""
    plain = Schedule(schedule.seed)
    for name in ("duplicate", "reorder", "cloud_offset", "cloud_drift", "profile", "apart",
                 "hold_max"):  # fmt: skip
        yield replace(schedule, **{name: getattr(plain, name)})
    if not schedule.events:
        return
    if len(schedule.events) == 1:
        yield replace(schedule, events=())
    for n, event in enumerate(schedule.events):
        for shorter in (round(event.duration / 2, 2), round(event.duration, 1)):
            if 0.0 < shorter < event.duration:
                yield _with(schedule, n, replace(event, duration=shorter))
        if event.way == "both":
            yield _with(schedule, n, replace(event, way="up"))
            yield _with(schedule, n, replace(event, way="down"))
        if round(event.at, 1) != event.at:
            yield _with(schedule, n, replace(event, at=round(event.at, 1)))


def _with(schedule: Schedule, n: int, event: Event) -> Schedule:
    events = schedule.events
    return replace(schedule, events=(*events[:n], event, *events[n + 1 :]))
