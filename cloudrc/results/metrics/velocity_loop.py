# SPDX-License-Identifier: Apache-2.0

"""Fit a first-order model of the velocity loop to a recorded flight.

Per axis, the model is v' = (K u(t - d) - v) / T with time constant T, dead time d and gain K. The
fit minimises the squared difference of measured and simulated velocity by Gauss-Newton steps.

The residuals of neighbouring samples are correlated. Therefore the 95 % intervals come from the
scatter of ten blocks of the recording, which are almost independent.
"""

from __future__ import annotations

from itertools import accumulate
from typing import Any, NamedTuple, TypeAlias

import numpy as np
from numpy.typing import NDArray

from cloudrc.base.outside.values import InvalidValueError
from cloudrc.results.record.columns import Recording
from cloudrc.wire.messages import GuardState

Array: TypeAlias = NDArray[np.float64]
INPUT, OUTPUT = "/reference", "/ground_truth"
"""Topics with the commanded and the measured velocity."""
DT = 0.01
"""Time between two samples of the fit [s]."""
UNKNOWN = -1
"""In place of the guard's state in a hole of the recording."""
START = 100
"""Number of first samples that the fit leaves out, because the earlier input is unknown."""
TAKE_OFF = 2.0
"""Time after the beginning of TRACK that is left out [s]."""
BLOCKS, T_QUANTILE = 10, 2.262
"""Number of blocks, and the 97.5 % quantile of Student's t with 9 degrees of freedom."""
DURATION_MIN, DEVIATION_MIN, SHARE_MIN = 20.0, 0.1, 0.8
"""Least duration [s], deviation of the input [m/s], and explained share [1] for a valid fit."""


class Fit(NamedTuple):
    """The fitted parameters of the velocity loop along one axis, and their uncertainty."""

    values: Array  # time constant [s], dead time [s] and gain [1], shape (3,)
    half_widths: Array  # half of the 95 % intervals of `values` [s], [s] and [1], shape (3,)
    share: float  # share of the variance of the velocity that the model explains [1]


def series(recording: Recording) -> tuple[Array, Array]:
    """Return the commanded and the measured velocity [m/s], one sample per `DT`, shape (n, 3) each.

    The samples are from the longest phase with the guard in TRACK, without its take-off. A phase
    ends where messages are lost.
    """
    for topic in (INPUT, OUTPUT, "/guard"):
        if not len(recording[topic]):
            raise InvalidValueError(f"has no {topic}; name the recording of a whole flight")
    source, sink = recording[INPUT], recording[OUTPUT]
    begins_ns, states = _states(recording)
    ends_ns = np.append(begins_ns[1:], sink["stamp_ns"][-1])
    tracks = np.where(states == GuardState.TRACK, ends_ns - begins_ns, 0)
    longest = int(tracks.argmax())
    start_ns, end_ns = begins_ns[longest] + int(TAKE_OFF * 1e9), ends_ns[longest]
    end_ns = end_ns if tracks[longest] else start_ns
    if (flown := (end_ns - start_ns) * 1e-9) < DURATION_MIN:
        raise InvalidValueError(
            f"{max(0.0, flown):.4g} s of flight under commands after the take-off, without lost "
            f"messages, and the fit needs {DURATION_MIN:g} s; record a longer flight"
        )
    at_ns = np.arange(start_ns, end_ns, int(DT * 1e9))
    held = source["stamp_ns"].searchsorted(at_ns, "right") - 1
    given, columns = source["reference"][np.maximum(held, 0)], sink["velocity"].T
    measured = np.stack([np.interp(at_ns, sink["stamp_ns"], column) for column in columns], axis=1)
    return given, measured


def _states(recording: Recording) -> tuple[Array, Array]:
    """Return the stamps of the guard's changes [ns], shape (n,), and its states since then.

    A hole of the recording begins with no state, and ends with the state in the next telemetry.
    """
    guard, telemetry = recording["/guard"], recording["/telemetry"]
    found = list(zip(guard["stamp_ns"].tolist(), guard["state"].tolist(), strict=True))
    for hole in recording.holes:
        found.append((hole.begin_ns, UNKNOWN))
        later = telemetry["guard"][telemetry["stamp_ns"] >= hole.end_ns]
        found += [(hole.end_ns, int(state)) for state in later[:1]]
    stamps_ns, states = np.array(sorted(found)).T
    return stamps_ns, states


def identify(given: Array, measured: Array) -> Fit:
    """Fit the model of the velocity loop to the velocities along one axis, one sample per DT.

    Args:
        given: Input velocities [m/s], shape (n,).
        measured: Output velocities [m/s], shape (n,).

    Raises:
        InvalidValueError: If the input does not excite the axis, or if the model does not fit.
    """
    if given.std() < DEVIATION_MIN:
        raise InvalidValueError(
            f"the commanded velocity hardly changes (standard deviation {given.std():.2g} "
            f"m/s, below {DEVIATION_MIN:g}); record a flight with more steps, as 'cloudrc run "
            "steps --mode virtual --set mission.steps.count=40'"
        )

    def residuals(theta: Array) -> Array:
        return (measured - simulate(given, theta, measured[0]))[START:]

    starts = [np.array([t, d, 1.0]) for t in (0.1, 0.3, 0.8) for d in (0.0, 0.1, 0.3)]
    theta = min(starts, key=lambda start: float((residuals(start) ** 2).sum()))
    for _ in range(20):
        error, slopes = residuals(theta), _slopes(residuals, theta)
        change = np.linalg.lstsq(slopes, -error, rcond=None)[0]
        if theta[1] == 0.0 and change[1] < 0.0:  # the dead time stays at its limit
            change[[0, 2]] = np.linalg.lstsq(slopes[:, [0, 2]], -error, rcond=None)[0]
        tries = [
            np.maximum(theta + share * change, (2.0 * DT, 0.0, 0.0))
            for share in (1.0, 0.5, 0.2, 0.05)
        ]
        best = min([theta, *tries], key=lambda each: float((residuals(each) ** 2).sum()))
        if np.abs(best - theta).max() < 1e-5:
            break
        theta = best
    error, slopes = residuals(theta), _slopes(residuals, theta)
    share = 1.0 - error.var() / measured.var()
    if share < SHARE_MIN:
        raise InvalidValueError(
            f"a first-order model explains {share:.0%} of the velocity, below "
            f"{SHARE_MIN:.0%}; record a flight in free air, without HOLD and without contact"
        )
    blocks = np.array_split(slopes * error[:, None], BLOCKS)
    scores = np.array([block.sum(axis=0) for block in blocks])
    inverse = np.linalg.pinv(slopes.T @ slopes)
    variance = inverse @ (scores.T @ scores) @ inverse * BLOCKS / (BLOCKS - 1)
    return Fit(theta, T_QUANTILE * np.sqrt(variance.diagonal()), float(share))


def simulate(given: Array, theta: Array, start: float) -> Array:
    """Simulate the velocity loop; return its velocity at each sample [m/s], shape (n,).

    `given` is the commanded velocity [m/s], shape (n,). `theta` is (T [s], d [s], K [1]). `start`
    is the velocity at the first sample [m/s].
    """
    constant, dead, gain = theta
    at = np.arange(len(given)) * DT
    late = np.interp(at - dead, at, given) * gain
    decay = float(np.exp(-DT / constant))
    steps = ((1.0 - decay) * late[:-1]).tolist()
    return np.array(list(accumulate(steps, lambda v, u: decay * v + u, initial=float(start))))


def _slopes(residuals: Any, theta: Array) -> Array:
    """Return the derivatives of n residuals by the three parameters `theta`, shape (n, 3)."""
    step = 0.5 * DT
    pairs = [(theta + change, theta - change) for change in np.eye(3) * step]
    return np.stack([(residuals(a) - residuals(b)) / (2.0 * step) for a, b in pairs], axis=1)
