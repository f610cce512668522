# SPDX-License-Identifier: Apache-2.0

"""Measure in one flight what the paper states; times are in seconds since the mission's start."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise
from typing import Any

import numpy as np

from cloudrc.results.metrics.control import estimator_samples, round_trips, tracking_errors
from cloudrc.results.metrics.flight import Flight

START = 1.0
"""Time in which eq. (1) has too few samples for a mean; its spread does not count [s]."""
LAST = 0.5
"""Last part of the way to a waypoint, in which the error counts as settled [s]."""
FALLEN = 0.1
"""Share of its peak to which the error has to fall [1]."""


def measure(flight: Flight, changes: Sequence[float]) -> dict[str, Any]:
    """Measure a flight over a link that changes at `changes` [s], on world's clock in virtual time.

    Return {} if the robot never flew.
    """
    if flight.end_ns is None or not len(flight.control["stamp_ns"]):
        return {}
    edges = [*(float(flight.seconds(each * 1e9)) for each in (0.0, *changes)), flight.duration]
    return {**_delays(flight, edges), **_filter(flight, edges), **_errors(flight)}


def _delays(flight: Flight, edges: Sequence[float]) -> dict[str, Any]:
    """Return mean and half of the range of the delays [s], in each part of the link's schedule."""
    ways = [flight.during(f"/{way}_delay") for way in ("uplink", "downlink")]
    arrived, delays = (
        np.concatenate([way[name] for way in ways]) for name in ("stamp_ns", "delay")
    )
    trips = round_trips(flight)
    found = {}
    for name, stamps_ns, values, since_sent in (
        ("one_way", arrived, delays, delays),
        ("round_trip", trips["stamp_ns"], trips["rtt"], trips["loop_delay"]),
    ):
        times = flight.seconds(stamps_ns)
        parts = (
            values[(times - since_sent >= begin) & (times < end) & np.isfinite(values)]
            for begin, end in pairwise(edges)
        )
        found[name] = [[float(part.mean()), float(np.ptp(part)) / 2] for part in parts if len(part)]
    return found


def _filter(flight: Flight, edges: Sequence[float]) -> dict[str, Any]:
    """Return how much less the estimate of eq. (1) varies than its samples, and how late it is.

    `half_after` is, for each change, after which time the estimate has made half of the way to the
    mean of the new samples; None if it never has before the next change. `behind` is how far it is
    from this mean at the end of the flight. Without a change there are neither. All are in seconds.
    """
    samples, control = estimator_samples(flight), flight.control
    at, tau = flight.seconds(samples["stamp_ns"]), samples["loop_delay"]
    times, estimate = flight.seconds(control["stamp_ns"]), control["horizon"]
    begin = float(flight.seconds(flight.start_ns)) + START
    late, settled = tau[at >= begin], estimate[times >= begin]
    if not len(late) or not len(settled):
        return {}
    found: dict[str, Any] = {"samples_sd": float(late.std()), "estimate_sd": float(settled.std())}
    parts = (tau[(at >= begin) & (at < end)] for begin, end in pairwise(edges))
    means = [float(part.mean()) if len(part) else np.nan for part in parts]
    half_after = list[float | None]()
    for target, (change, end) in zip(means[1:], pairwise(edges[1:]), strict=True):
        during = (times >= change) & (times < end)
        if during.any():
            way = (estimate[during] - estimate[during][0]) / (target - estimate[during][0])
            half = np.flatnonzero(way >= 0.5)
            half_after.append(float(times[during][half[0]]) - change if len(half) else None)
    if half_after:
        found |= {"half_after": half_after, "behind": means[-1] - float(estimate[-1])}
    return found


def _errors(flight: Flight) -> dict[str, Any]:
    """Return for each waypoint the peak of the error, when it has fallen, and what is left of it.

    The error is the distance from reference to measured position [m], as in the paper. `fallen` is
    the time from the peak until the error is a tenth of it [s]; None if it never is. `left` is the
    mean error before the next waypoint [m]; the last waypoint has none.
    """
    control = flight.control
    times = flight.seconds(control["stamp_ns"])
    errors = np.linalg.norm(tracking_errors(flight, control["measured"]), axis=1)
    waypoints = control["waypoint"]
    found: dict[str, list[Any]] = {"peak": [], "fallen": [], "left": []}
    for waypoint in np.unique(waypoints[waypoints >= 0]):
        rows = waypoints == waypoint
        at, error = times[rows], errors[rows]
        top = int(error.argmax())
        low = np.flatnonzero(error[top:] <= FALLEN * error[top])
        found["peak"].append(float(error[top]))
        found["fallen"].append(float(at[top + low[0]] - at[top]) if len(low) else None)
        found["left"].append(float(error[at > at[-1] - LAST].mean()))
    return {**found, "left": found["left"][:-1]}
