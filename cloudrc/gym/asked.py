# SPDX-License-Identifier: Apache-2.0

"""Compute what a link asks for: the mean delay and the loss of messages.

Over a schedule, it is that of the part which an episode meets. Without a rate, packets are the
mean of the pieces of the schedule by their time. With one, packets act on those behind them, so
the numbers of each piece come from the model, as do those of larger messages and of streams.
"""

from __future__ import annotations

from functools import lru_cache
from math import ceil, isnan, nan
from statistics import NormalDist
from typing import NamedTuple

import numpy as np

from cloudrc.gym.lane import DATAGRAMS, Lane, Wire
from cloudrc.link.draws import PARETO_CUT, Floats
from cloudrc.link.library import KIND, OneWay
from cloudrc.link.model import LinkDirection
from cloudrc.link.profile import (
    Conditions,
    DirectionProfile,
    GilbertElliott,
    LinkSchedule,
    mean_loss,
    whole_share,
)
from cloudrc.link.queue import NOTHING_NS
from cloudrc.link.streams import sample

PACKETS = 10_000
"""Least number of packets that the model sends over a schedule, and most messages for a mean."""
PIECES, MESSAGES_MIN = 50_000, 200
"""Number of packets of larger messages that the model sends, and the least number of messages."""
SETTLED_NS = 100_000_000_000
"""Time after which what is still repaired counts as lost [ns]."""
SETTLED = 1_000
"""Number of packets that it sends after the last change of a schedule that ends."""
_GRID = 1_000  # number of quantiles of a distribution


class Met(NamedTuple):
    """The part of a schedule that an episode meets."""

    start_ns: int
    duration_ns: int


class AskedOfWire:
    """What a wire asks for in the episodes of one link."""

    def __init__(self, wire: Wire, period: float) -> None:
        """Take messages, one per `period` [s]."""
        self._wire, self._period = wire, period
        self._parts = _parts_of(wire, period)
        # A queue that fills has no mean but that of the messages which were sent.
        fills = self._parts is None and wire.exceeds_rate(period)
        self._always = None if self._parts or fills else expected(wire, period)

    def of(self, met: Met) -> tuple[float, float]:
        """Return the mean delay [s] and the loss of messages in what was met."""
        if self._parts:
            return self._parts.of(met)
        count = ceil(met.duration_ns * 1e-9 / self._period)
        return self._always or expected(self._wire, self._period, count)


@lru_cache(maxsize=64)
def _parts_of(wire: Wire, period: float) -> PartsAsked | None:
    """Return what a wire asks for over time; None if it is always the same."""
    return PartsAsked(wire, period) if LinkSchedule(wire.profile).only() is None else None


@lru_cache(maxsize=64)
def expected(wire: Wire, period: float, count: int = 0) -> tuple[float, float]:
    """Return the mean delay [s] and the loss of messages, one per `period` [s], from time 0 on.

    `count` is the number of messages in several packets, or of a stream; 0: as many as the model
    needs for a mean.
    """
    profile, pieces = wire.profile, wire.cut.usual
    if wire.is_plain:
        asked = OneWay(profile, 0, wire.asked_uplink).expected(period, wire.size)
        return asked.mean, asked.loss
    sent_ns = np.arange(count or _messages(pieces)) * round(period * 1e9)
    delays = _delays_of(wire, sent_ns.tolist(), 0)
    came = delays[np.isfinite(delays)]
    loss = 1.0 - len(came) / len(delays)
    is_simple = wire.delivery == DATAGRAMS and isnan(wire.occupies)
    only = LinkSchedule(profile).only() if is_simple else None
    if only is not None and not only.blackout:
        loss = 1.0 - (1.0 - profile.corrupt) ** pieces * whole_share(only.loss, pieces)
    return float(came.mean()) if len(came) else nan, loss


def _messages(pieces: int) -> int:
    """Return of how many messages in `pieces` packets a mean is computed."""
    return min(max(MESSAGES_MIN, PIECES // pieces), PACKETS)


def _delays_of(wire: Wire, sent_ns: list[int], episode: int) -> Floats:
    """Send messages at these times [ns] through the model; return their delays [s], NaN if lost."""
    if wire.is_plain:
        link = LinkDirection(wire.profile, 0, wire.asked_uplink, stream=" asked")
        turn = wire.profile.phase_packets
        return sample(link, KIND, sent_ns, wire.size, epoch=episode, turn=turn).delays
    lane, delays = Lane(wire, 0, " expected"), np.full(len(sent_ns), nan)
    lane.begin(episode)
    for number, now_ns in enumerate(sent_ns):
        lane.send(number, now_ns, number)
    lane.run(sent_ns[-1] + SETTLED_NS)
    while lane.queue.next_ns < NOTHING_NS:
        arrival_ns, _, number = lane.queue.pop()
        delays[number] = (arrival_ns - sent_ns[number]) * 1e-9
    return delays


class PartsAsked:
    """What a direction asks for over time; it is computed once, and then looked up."""

    def __init__(self, wire: Wire, period: float) -> None:
        """Take messages, one per `period` [s]."""
        self._schedule = schedule = LinkSchedule(wire.profile)
        self._edges_ns = np.array(schedule.pass_ns, dtype=float)
        if wire.is_plain and not _is_coupled(wire.profile, schedule):
            means = _exactly(wire.profile, schedule)
        else:
            means = _by_model(wire, schedule, period)
        delays, losses = means.T
        # Rows: lost, arrived, and arrived times delay; per time.
        self._rates = np.stack([losses, 1.0 - losses, (1.0 - losses) * np.nan_to_num(delays)])
        spans = np.diff(self._edges_ns)
        before = np.cumsum(self._rates[:, :-1] * spans, axis=1)
        self._sums = np.concatenate([np.zeros((3, 1)), before], axis=1)
        self._of_period = np.zeros(3)
        if schedule.period_ns is not None:
            rest_ns = schedule.period_ns - self._edges_ns[-1]
            self._of_period = self._sums[:, -1] + self._rates[:, -1] * rest_ns

    def of(self, met: Met) -> tuple[float, float]:
        """Return the mean delay [s] of the packets that arrive, and the loss, of a part."""
        until_ns = met.start_ns + max(1, met.duration_ns)
        lost, arrived, delayed = (self._until(until_ns) - self._until(met.start_ns)).tolist()
        return delayed / arrived if arrived > 0.0 else nan, lost / (lost + arrived)

    def _until(self, time_ns: int) -> Floats:
        """Return the sums from the beginning of the schedule to a time [ns], shape (3,)."""
        passes, period_ns = 0, self._schedule.period_ns
        if period_ns is not None:
            passes, time_ns = divmod(time_ns, period_ns)
        place = int(np.searchsorted(self._edges_ns, time_ns, side="right")) - 1
        rest_ns = time_ns - self._edges_ns[place]
        found: Floats = self._sums[:, place] + self._rates[:, place] * rest_ns
        return found + passes * self._of_period


def _is_coupled(profile: DirectionProfile, schedule: LinkSchedule) -> bool:
    """Return whether the delay of a packet depends on its time, or on those before it."""
    has_rate = profile.opportunities or any(each.rate is not None for each in schedule.pieces)
    if profile.radio:
        return True
    return bool(has_rate) or (profile.keep_order and any(each.jitter for each in schedule.pieces))


def _exactly(profile: DirectionProfile, schedule: LinkSchedule) -> Floats:
    """Return mean delay [s] and loss of packets in each piece, shape (n, 2)."""
    return np.array([_means(profile, each) for each in schedule.pieces])


def _means(profile: DirectionProfile, each: Conditions) -> tuple[float, float]:
    loss, delay = mean_loss(each.loss), each.delay_ns * 1e-9
    if each.blackout or loss >= 1.0:
        return nan, 1.0
    if each.jitter:
        values = np.maximum(0.0, delay + each.jitter * np.array(_quantiles(profile)))
        sooner = np.arange(len(values), 0, -1) * 2.0 - 1.0  # of two copies, the first counts
        first = float(values @ sooner) / len(values) ** 2
        delay = float(values.mean()) * (1.0 - profile.duplicate) + first * profile.duplicate
    if isinstance(each.loss, GilbertElliott):
        bad = each.loss.bad_start / (each.loss.bad_start + each.loss.bad_end or 1.0)
        share = bad * (1.0 - each.loss.loss_bad) / (1.0 - loss)
        delay += share * each.loss.delay_bad_ms * 1e-3
    if not profile.keep_order:
        delay *= 1.0 - profile.reorder
    return delay, 1.0 - (1.0 - loss) * (1.0 - profile.corrupt)


def _quantiles(profile: DirectionProfile) -> tuple[float, ...]:
    """Return quantiles of the jitter with mean 0, rising, in units of the jitter."""
    return profile.quantiles or _shape(profile.distribution)


@lru_cache
def _shape(distribution: str) -> tuple[float, ...]:
    shares = (np.arange(_GRID) + 0.5) / _GRID
    if distribution == "uniform":
        return tuple((2.0 * shares - 1.0).tolist())
    if distribution == "normal":
        values = np.array([NormalDist().inv_cdf(share) for share in shares])
    else:
        values = (PARETO_CUT + (1.0 - PARETO_CUT) * (1.0 - shares)) ** (-1 / 3)
    return tuple(((values - values.mean()) / values.std()).tolist())


def _by_model(wire: Wire, schedule: LinkSchedule, period: float) -> Floats:
    """Return mean delay [s] and loss in each piece, of messages that are sent through the model."""
    period_ns, pass_ns = round(period * 1e9), schedule.period_ns
    least = PACKETS if wire.is_plain else _messages(wire.cut.usual)
    count = (pass_ns or schedule.pass_ns[-1] + SETTLED * period_ns) // period_ns + 1
    passes = -(-least // count)
    if pass_ns is not None:  # the packets go on from one pass to the next
        count, passes = count * passes, 1
    sent_ns = np.arange(count) * period_ns
    every = np.concatenate([_delays_of(wire, sent_ns.tolist(), each) for each in range(passes)])
    time_ns = sent_ns if pass_ns is None else sent_ns % pass_ns
    place = np.tile(np.searchsorted(schedule.pass_ns, time_ns, side="right") - 1, passes)
    found = _exactly(wire.profile, schedule)
    for n in np.unique(place):
        own = every[place == n]
        came = own[np.isfinite(own)]
        found[n] = came.mean() if len(came) else nan, 1.0 - len(came) / len(own)
    return found
