"""Define the conditions of a link direction and how they change over time, in SI units.

All delays are ONE WAY. The classes mirror `config/schema.py`, which reads files in milliseconds.
`config` and `link/traces.py` check the values; this module does not.
"""

from __future__ import annotations

from bisect import bisect_right
from dataclasses import dataclass, replace
from math import inf
from typing import Literal, NamedTuple, TypeAlias


@dataclass(frozen=True, slots=True)
class GilbertElliott:
    """Loss in bursts: a two-state Markov chain with one step per packet.

    Source: E. N. Gilbert, Bell Syst. Tech. J. 39, 1960; E. O. Elliott, ibid. 42, 1963. In the terms
    of tc-netem's `gemodel`: p = bad_start, r = bad_end, 1-h = loss_bad, 1-k = loss_good.
    """

    bad_start: float  # probability per packet to go from the good to the bad state, in [0, 1]
    bad_end: float  # probability per packet to go from the bad to the good state, in [0, 1]
    loss_bad: float = 1.0  # loss in the bad state, in [0, 1]
    loss_good: float = 0.0  # loss in the good state, in [0, 1]
    delay_bad: float = 0.0  # extra delay in the bad state, one way [s]


Loss: TypeAlias = float | GilbertElliott
"""Probability of an independent loss in [0, 1], or model of loss in bursts."""


def mean_loss(loss: Loss) -> float:
    """Return the share of packets lost in the long run, in [0, 1]."""
    if not isinstance(loss, GilbertElliott):
        return loss
    bad = loss.bad_start / (loss.bad_start + loss.bad_end) if loss.bad_start else 0.0
    return bad * loss.loss_bad + (1.0 - bad) * loss.loss_good


@dataclass(frozen=True, slots=True)
class Change:
    """A change of a link's conditions at one time; None leaves a value unchanged."""

    at: float  # time since the link came up [s]
    delay: float | None = None  # mean one-way delay [s]
    jitter: float | None = None  # [s]
    loss: Loss | None = None
    rate: float | None = None  # [bit/s]


@dataclass(frozen=True, slots=True)
class Blackout:
    """An interval in which all packets are lost; `start` is the time since the link came up [s]."""

    start: float
    duration: float  # [s]


@dataclass(frozen=True, slots=True)
class Trace:
    """Measured conditions over time: each row applies until the time of the next row.

    The delays replace the profile's `delay`; the profile's jitter is added to them. If the trace
    has losses, they replace the profile's `loss`. The first row also applies before its time.

    The last row applies forever. In a trace that loops, the last row lasts as long as the other
    rows on average; then the trace begins again.
    """

    times: tuple[float, ...]  # since the link came up, strictly rising [s], shape (n,), n >= 1
    delays: tuple[float, ...]  # one-way delay of each row [s], shape (n,)
    losses: tuple[float, ...] | None = None  # loss of each row in [0, 1], shape (n,)
    loop: bool = False  # whether the trace begins again after its end

    @property
    def period(self) -> float | None:
        """Return the time after which the trace begins again [s]; None if it never begins again."""
        if not self.loop or len(self.times) < 2:
            return None
        return self.times[-1] + (self.times[-1] - self.times[0]) / (len(self.times) - 1)


@dataclass(frozen=True, slots=True)
class DirectionProfile:
    """Requested conditions of one direction.

    A negative sum of delay and jitter counts as 0. `keep_order` disables `reorder`. A packet that
    finds the bottleneck's queue full is dropped. If `distribution` is "table", `table` has equally
    probable values: mean 0, standard deviation 1, rising, shape (n,).
    """

    delay: float = 0.0  # mean one-way delay [s]
    jitter: float = 0.0  # half width (uniform) or standard deviation (others) of the delay [s]
    distribution: Literal["uniform", "normal", "pareto", "table"] = "uniform"
    correlation: float = 0.0  # correlation of the jitter of successive packets, in [0, 1]
    loss: Loss = 0.0
    duplicate: float = 0.0  # probability of a copy with its own delay, in [0, 1]
    reorder: float = 0.0  # probability that a packet has no delay and skips the queue, in [0, 1]
    corrupt: float = 0.0  # probability of a flipped bit, the same in all copies, in [0, 1]
    keep_order: bool = False  # whether packets arrive in the order of sending
    rate: float | None = None  # rate of the bottleneck [bit/s]; None without a bottleneck
    queue_packets: int = 1000  # capacity of the bottleneck, including the packet on the wire
    changes: tuple[Change, ...] = ()  # strictly rising in `at`
    trace: Trace | None = None
    blackouts: tuple[Blackout, ...] = ()  # in any order; they may overlap
    table: tuple[float, ...] = ()  # values of the distribution "table", in units of `jitter` [1]


class Conditions(NamedTuple):
    """The constant conditions during one piece of a time line."""

    delay_ns: int  # mean one-way delay [ns]
    jitter: float  # [s]
    loss: Loss
    rate: float | None  # [bit/s]
    blackout: bool


class Timeline:
    """The conditions of one direction over time, from its changes, trace and blackouts.

    Attributes:
        pieces: The conditions in each piece of the time line, constant within the piece. If the
            time line loops, the pieces are those of one period.
        pass_ns: Start of each piece [ns], rising; 0 is the time at which the link came up.
        period_ns: Period of a looping time line [ns]; None if the time line does not loop.
    """

    def __init__(self, profile: DirectionProfile) -> None:
        instants = {0.0, *(change.at for change in profile.changes)}
        instants.update(profile.trace.times if profile.trace else ())
        for blackout in profile.blackouts:
            instants.update((blackout.start, blackout.start + blackout.duration))
        period = profile.trace.period if profile.trace else None
        self.period_ns = None if period is None else round(period * 1e9)
        end_ns = inf if self.period_ns is None else self.period_ns
        ordered = [instant for instant in sorted(instants) if round(instant * 1e9) < end_ns]
        self.pass_ns = [round(instant * 1e9) for instant in ordered]
        self.pieces = [_conditions(profile, instant) for instant in ordered]

    def at(self, elapsed_ns: int) -> Conditions:
        """Return the conditions at the time `elapsed_ns` [ns] after the link came up."""
        if self.period_ns is not None and elapsed_ns > 0:
            elapsed_ns %= self.period_ns
        return self.pieces[max(bisect_right(self.pass_ns, elapsed_ns) - 1, 0)]

    @property
    def last_ns(self) -> float:
        """Time from the start of the link to the last change [ns]; infinite if changes repeat."""
        return self.pass_ns[-1] if self.period_ns is None else inf

    def only(self) -> Conditions | None:
        """Return the conditions if they never change, otherwise None."""
        return self.pieces[0] if len(self.pieces) == 1 else None


def settled(profile: DirectionProfile) -> DirectionProfile:
    """Return the profile with constant conditions: those of the last piece of its time line."""
    last = Timeline(profile).pieces[-1]
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
    delay, jitter, loss, rate = profile.delay, profile.jitter, profile.loss, profile.rate
    for change in profile.changes:
        if change.at > instant:
            break
        delay = delay if change.delay is None else change.delay
        jitter = jitter if change.jitter is None else change.jitter
        loss = loss if change.loss is None else change.loss
        rate = rate if change.rate is None else change.rate
    if (trace := profile.trace) is not None:
        row = max(bisect_right(trace.times, instant) - 1, 0)
        delay = trace.delays[row]
        loss = loss if trace.losses is None else trace.losses[row]
    blackout = any(b.start <= instant < b.start + b.duration for b in profile.blackouts)
    return Conditions(round(delay * 1e9), jitter, loss, rate, blackout)
