"""When a time line began, by what was heard: delays over time come in, its beginning goes out.

The end that hears a direction is not told: the shaper runs in the other pod. But delays that change
tell where on its time line a link is.
"""

from __future__ import annotations

from collections.abc import Callable
from math import inf

import numpy as np

from cloudrc.link.profile import DirectionProfile
from cloudrc.link.timeline import Timeline
from cloudrc.link.verify_reference import Floats

COARSE, FINE = 0.01, 2e-3
"""Steps of the search [s]."""
EARLIER, LATER = 5.0, 0.2
"""It may have begun so long before or after what is looked at, the time line's length apart [s]."""
SPAN_MAX = 300.0
"""Longest time line that is searched [s]."""
_REACH = 0.03
_TELLING = 1000
_LOST = 0.05
"""A loss where none should be, or none in a blackout, counts like so much delay [s]."""


def length(profile: DirectionProfile) -> float:
    """Say after which time conditions do not change any more [s]."""
    return Timeline(profile).starts_ns[-1] * 1e-9


def search(
    profile: DirectionProfile,
    sent: Floats,
    delay: Floats,
    breathe: Callable[[], None] = lambda: None,
) -> float:
    """Find roughly when a time line began, on the clock of `sent` [s].

    Args:
        profile: Whose time line.
        sent: When each datagram left, from the first [s], shape (n,).
        delay: Of each [s], shape (n,); NaN if it was lost.
        breathe: Called now and then.
    """
    timeline = Timeline(profile)
    starts = np.array(timeline.starts_ns) * 1e-9
    pieces = [timeline.at(start_ns) for start_ns in timeline.starts_ns]
    base = np.array([piece.delay_ns * 1e-9 for piece in pieces])
    dark = np.array([piece.blackout for piece in pieces])
    lost = ~np.isfinite(delay)
    here = np.where(lost, 0.0, delay)

    def cost(origin: float) -> float:
        index = np.maximum(np.searchsorted(starts, sent - origin, side="right") - 1, 0)
        wrong = np.where(lost == dark[index], np.abs(here - base[index]), _LOST)
        wrong[lost & dark[index]] = 0.0
        return float(np.minimum(wrong, _LOST).sum())

    best, least = 0.0, inf
    earliest = -(min(SPAN_MAX, length(profile)) + EARLIER)
    for origin in np.arange(LATER, earliest, -COARSE).tolist():
        found = cost(origin)
        if found < least - 1e-9:  # of equals the latest
            best, least = origin, found
        breathe()
    return best


def around(coarse: float) -> list[float]:
    """Give what may be the beginning, near a coarse one [s]."""
    near: list[float] = np.arange(coarse - _REACH, coarse + _REACH, FINE).tolist()
    return [coarse, *near]


def near_changes(profile: DirectionProfile, elapsed: Floats) -> slice:
    """Choose a thousand datagrams, sent at `elapsed` [s], that tell most of where they are."""
    starts = np.array(Timeline(profile).starts_ns[1:]) * 1e-9
    inside = starts[(starts > elapsed[0]) & (starts < elapsed[-1])]
    if not len(inside):
        return slice(0, _TELLING)
    first = max(0, int(np.searchsorted(elapsed, inside[0])) - _TELLING // 4)
    return slice(first, first + _TELLING)
