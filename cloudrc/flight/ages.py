# SPDX-License-Identifier: Apache-2.0

"""Compute how old commands and their confirmations become, before a flight.

The delays are those of the flight, because link and cloud draw the same random numbers.
"""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING, NamedTuple, TypeAlias

import numpy as np
from numpy.typing import NDArray

from cloudrc.config.link_schedule import find_ways
from cloudrc.flight.assembly.cloud import build_compute_time
from cloudrc.link.draws import BLOCK, OVERTAKES, impairments, stream_key
from cloudrc.link.model import LinkDirection
from cloudrc.wire.messages import NEVER_NS, plan_length
from cloudrc.wire.tunnel.codec import COMMAND_SIZES, TELEMETRY_SIZES, Kind

if TYPE_CHECKING:
    from cloudrc.config.resolved import ResolvedExperiment

DURATION_NS = 20_000_000_000
"""Time of the streams [ns]."""
Array: TypeAlias = NDArray[np.int64]


class _Arrivals(NamedTuple):
    """The arrivals of a stream of datagrams, the earliest first."""

    at_ns: Array  # times of arrival [ns], shape (n,)
    newest: Array  # number of the datagram that the far end uses from then on [1], shape (n,)
    at_once: Array  # whether the datagram arrived when its end began to make it, shape (n,)

    def used_before(self, times_ns: Array) -> Array:
        """Return the number of the datagram in use before each time [ns], shape (m,); -1: none."""
        return np.append(self.newest, -1)[self.at_ns.searchsorted(times_ns) - 1]


def simulate_ages(experiment: ResolvedExperiment) -> tuple[list[float], list[float]]:
    """Compute the ages of telemetry and commands over the experiment's link, without blackouts.

    While cloud computes a command, it begins no other one.

    Return two lists of ages [s]: of the odometry from which cloud computed the command that world
    follows, and of the newest command that telemetry has confirmed. Both have an age at each
    departure and arrival of a datagram, just before it.
    """
    world, cloud = experiment.world, experiment.cloud
    plan = plan_length(cloud.plan_s)
    newest_wins = experiment.tunnel.order == "newest" or plan > 0
    grids_ns = [
        np.arange(0, DURATION_NS + period_ns, period_ns)
        for period_ns in (
            round(1e9 / rate) for rate in (world.odometry_rate_hz, cloud.command_rate_hz)
        )
    ]
    measured_ns, grid_ns = (grid_ns[grid_ns < DURATION_NS] for grid_ns in grids_ns)
    size = TELEMETRY_SIZES[len(experiment.robot.sensors)]
    up = _cross(experiment, Kind.TELEMETRY, size, measured_ns, measured_ns, newest_wins)
    heard_ns = up.at_ns.min(initial=DURATION_NS)
    if cloud.answers == "arrival":
        begun_ns, sent_ns = _answers(experiment, up)
    else:
        begun_ns, sent_ns = _commands(experiment, grid_ns[grid_ns >= heard_ns])
    down = _cross(experiment, Kind.COMMAND, COMMAND_SIZES[plan], begun_ns, sent_ns, newest_wins)
    times_ns = np.unique(np.concatenate([*grids_ns, sent_ns, up.at_ns, down.at_ns]))
    times_ns = times_ns[1 : times_ns.searchsorted(DURATION_NS) + 1]
    basis_ns = measured_ns[up.used_before(begun_ns + 1)]
    # Telemetry leaves before a command of the same time, even if this needs no time at all.
    echoed = down._replace(at_ns=down.at_ns + down.at_once).used_before(measured_ns + 1)
    echo_ns = np.append(begun_ns, NEVER_NS)[echoed]
    ages = _ages(times_ns, basis_ns, down.used_before(times_ns))
    return ages, _ages(times_ns, echo_ns, up.used_before(times_ns))


def _commands(experiment: ResolvedExperiment, grid_ns: Array) -> tuple[Array, Array]:
    """Return when cloud begins each command, and when it sends it [ns].

    `grid_ns` are the begins of the periods since the first telemetry arrived [ns], shape (n,).
    """
    compute = build_compute_time(experiment)
    if compute is None or not len(grid_ns):
        return grid_ns, grid_ns
    period_ns, begin_ns = round(1e9 / experiment.cloud.command_rate_hz), int(grid_ns[0])
    begun_ns, sent_ns = list[int](), list[int]()
    while begin_ns < DURATION_NS:
        begun_ns.append(begin_ns)
        sent_ns.append(begin_ns + compute.end(begin_ns))
        begin_ns = max(sent_ns[-1], (begin_ns // period_ns + 1) * period_ns)
    return np.array(begun_ns), np.array(sent_ns)


def _answers(experiment: ResolvedExperiment, up: _Arrivals) -> tuple[Array, Array]:
    """Return when cloud begins each command if it answers newer telemetry, and when it sends it."""
    compute = build_compute_time(experiment)
    period_ns = round(1e9 / experiment.cloud.command_rate_hz)
    news_ns = np.append(up.at_ns[np.diff(up.newest, prepend=-1) > 0], DURATION_NS)
    begun_ns, sent_ns, begin_ns = list[int](), list[int](), int(news_ns[0])
    while begin_ns < DURATION_NS:
        begun_ns.append(begin_ns)
        sent_ns.append(begin_ns + (compute.end(begin_ns) if compute else 0))
        next_ns = int(news_ns[news_ns.searchsorted(begin_ns, "right")])
        due_ns = min(max(next_ns, begin_ns + period_ns // 2), begin_ns + 3 * period_ns // 2)
        begin_ns = max(due_ns, sent_ns[-1])
    return np.array(begun_ns, np.int64), np.array(sent_ns, np.int64)


def _cross(
    experiment: ResolvedExperiment,
    kind: Kind,
    size: int,
    begun_ns: Array,
    sent_ns: Array,
    newest_wins: bool,
) -> _Arrivals:
    """Send datagrams of `size` bytes over one direction of the link; return their arrivals.

    `begun_ns` are the times at which their end began to make them, `sent_ns` those of sending [ns].
    """
    uplink = kind is Kind.TELEMETRY
    rate_hz = experiment.world.odometry_rate_hz if uplink else experiment.cloud.command_rate_hz
    numbers = (begun_ns // round(1e9 / rate_hz)).tolist()
    *ways, start_ns = find_ways(experiment)
    profile = replace(ways[0 if uplink else 1], blackouts=(), corrupt=0.0)
    link = LinkDirection(profile, experiment.seed, uplink, -start_ns, stream=experiment.stream)
    if (only := link.only) is not None:  # nearly all links: a call per block of packets
        key = stream_key(experiment.seed, uplink, 1, kind, experiment.stream)
        blocks = range(numbers[-1] // BLOCK + 1 if numbers else 0)
        tables = [impairments(key, block, profile, only.jitter, only.loss) for block in blocks]
        packets = [tables[number // BLOCK][number % BLOCK] for number in numbers]
    else:
        datagrams = zip(numbers, sent_ns.tolist(), strict=True)
        packets = [link.send(1, kind, number, size, now_ns) for number, now_ns in datagrams]
    copies = [(row, entry) for row, packet in enumerate(packets) for entry in packet]
    rows, at_ns = np.array(copies, np.int64).reshape(-1, 2).T
    if only is not None:
        delays_ns = np.where(at_ns == OVERTAKES, 0, only.delay_ns + at_ns)
        at_ns = sent_ns[rows] + np.maximum(delays_ns, 0)
    order = at_ns.argsort(kind="stable")
    rows, at_ns = rows[order], at_ns[order]
    newest = np.maximum.accumulate(rows) if newest_wins else rows
    return _Arrivals(at_ns, newest, at_ns == begun_ns[rows])


def _ages(times_ns: Array, stamps_ns: Array, used: Array) -> list[float]:
    """Return the ages of the stamps that datagrams have [s], at each of `times_ns` [ns].

    `stamps_ns` are the stamps of all datagrams [ns], or NEVER_NS. `used` are those in use at
    the times, -1 if none; then there is no age.
    """
    found_ns = np.append(stamps_ns, NEVER_NS)[used]
    known = found_ns != NEVER_NS
    ages: list[float] = ((times_ns[known] - found_ns[known]) * 1e-9).tolist()
    return ages
