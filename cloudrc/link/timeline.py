"""Which conditions hold when: a direction's changes, trace and blackouts become one list of pieces.

The model asks it for each packet, with the time since the link came up.
"""

from __future__ import annotations

from bisect import bisect_right
from dataclasses import replace
from typing import NamedTuple

from cloudrc.link.profile import DirectionProfile, Loss


class Conditions(NamedTuple):
    """What holds during one piece of time.

    Attributes:
        delay_ns: One way [ns].
        jitter: [s].
        loss: Chance, or bursts.
        rate: Of the bottleneck [bit/s]; None has none.
        blackout: True if nothing passes.
    """

    delay_ns: int
    jitter: float
    loss: Loss
    rate: float | None
    blackout: bool


class Timeline:
    """The conditions of one direction over time.

    Attributes:
        starts_ns: When each piece of it begins, since the link came up, rising [ns].
    """

    def __init__(self, profile: DirectionProfile) -> None:
        instants = {0.0}
        instants.update(change.at for change in profile.changes)
        instants.update(profile.trace.times if profile.trace else ())
        for blackout in profile.blackouts:
            instants.update((blackout.start, blackout.start + blackout.duration))
        ordered = sorted(instants)
        self.starts_ns = [round(instant * 1e9) for instant in ordered]
        self._pieces = [_conditions(profile, instant) for instant in ordered]

    def at(self, elapsed_ns: int) -> Conditions:
        """Say what holds `elapsed_ns` [ns] after the link came up."""
        return self._pieces[max(bisect_right(self.starts_ns, elapsed_ns) - 1, 0)]

    def least_delay_ns(self, reach: float) -> int:
        """Say which delay no packet falls below, whenever it is sent [ns], >= 0.

        Args:
            reach: How far below its mean a delay can fall, in units of the jitter [1].
        """
        passing = [piece for piece in self._pieces if not piece.blackout]
        least = [piece.delay_ns - round(reach * piece.jitter * 1e9) for piece in passing]
        return max(0, min(least, default=0))

    def only(self) -> Conditions | None:
        """Say what always holds; None if that changes over time."""
        return self._pieces[0] if len(self._pieces) == 1 else None


def settled(profile: DirectionProfile) -> DirectionProfile:
    """Give the conditions that hold for ever once a time line is over."""
    timeline = Timeline(profile)
    last = timeline.at(timeline.starts_ns[-1])
    return replace(
        profile,
        delay=last.delay_ns * 1e-9,
        jitter=last.jitter,
        loss=1.0 if last.blackout else last.loss,
        rate=last.rate,
        changes=(),
        trace=None,
        blackouts=(),
    )


def _conditions(profile: DirectionProfile, instant: float) -> Conditions:
    """Work out what holds from `instant` [s] until the next one on the time line."""
    delay, jitter, loss, rate = profile.delay, profile.jitter, profile.loss, profile.rate
    for change in profile.changes:
        if change.at > instant:
            break
        delay = delay if change.delay is None else change.delay
        jitter = jitter if change.jitter is None else change.jitter
        loss = loss if change.loss is None else change.loss
        rate = rate if change.rate is None else change.rate
    trace = profile.trace
    if trace is not None:
        row = max(bisect_right(trace.times, instant) - 1, 0)
        delay = trace.delays[row]
        loss = loss if trace.losses is None else trace.losses[row]
    blackout = any(b.start <= instant < b.start + b.duration for b in profile.blackouts)
    return Conditions(round(delay * 1e9), jitter, loss, rate, blackout)
