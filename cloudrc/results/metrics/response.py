# SPDX-License-Identifier: Apache-2.0

"""Metrics of the response to steps of the setpoint: overshoot, settling, errors, and stability.

A step begins when the setpoint changes and ends when it changes again, or when the mission ends.
Steps of which messages are lost are left out. A last step whose end was not flown or recorded has
neither settled nor failed to.
Setpoints that last less than 0.5 s belong to a moving reference and are no steps. Where a moving
reference stops, the robot is moving and still behind it: this end has no overshoot or settling time
that describes the loop. Only the verdict judges it. All errors are distances between the setpoint
and the true position.
"""

from __future__ import annotations

from functools import lru_cache, partial
from typing import NamedTuple

import numpy as np

from cloudrc.base.rounding import differences, exceeds
from cloudrc.results.metrics.control import tracking_errors
from cloudrc.results.metrics.flight import Array, Flight, add_measures, between, mean

SHORTEST_NS = 500_000_000
"""Shortest duration of a step, and its last part, in which the robot must have settled [ns]."""
JUMP_MAX = 3
"""Largest number of changes of the setpoint in `SHORTEST_NS` that are one step: a file of setpoints
moves in a straight line between two rows, also between two rows of a step."""
LENGTH_MIN = 0.05
"""Shortest length of a step [m]; the values of a shorter step would be noise."""
BAND = 0.05
"""Largest error of a settled robot, as a share of the step's length [1]."""
RISE = 0.1, 0.9
"""Shares of the step's length between which the rise time is measured [1]."""
ENDS_STEP = "done", "leg_timed_out"
"""Events that end a mission at the end of its last step; all others cut this step short."""
GROWTH_MIN = 0.15
"""Smallest amplitude of an unstable oscillation [m]; less may be noise."""


class Step(NamedTuple):
    """Response to one step of the setpoint; a time is None if the robot did not rise or settle."""

    waypoint: int  # index of the waypoint or step
    start: float  # time of the step since the start of the mission [s]
    length: float  # distance from the position at the start of the step to the setpoint [m]
    overshoot: float  # distance beyond the setpoint, as a share of `length` [1]
    rise_time: float | None  # time from 10 % to 90 % of the way [s]
    settling_time: float | None  # time after which the error stays within 5 % of `length` [s]
    iae: float  # integral of the error over time [m s]
    ise: float  # integral of the squared error over time [m^2 s]
    squared_command: float  # integral of the squared commanded velocity over time [m^2/s]
    last_error: float  # largest error in the last 0.5 s [m]
    unstable: bool  # whether the error oscillates without decay
    cut: bool  # whether the end of the step was not flown or recorded

    @property
    def is_unsettled(self) -> bool:
        """Whether the step was flown to its end, and the robot had not settled there."""
        return self.settling_time is None and not self.cut


def steps(flight: Flight) -> tuple[Step, ...]:
    """Measure the response to each step of a flight, in order."""
    return tuple(step for step, is_step in _measured(flight) if is_step)


def responses(flight: Flight) -> tuple[Step, ...]:
    """Measure the response to each step and to each end of a moving reference, in order."""
    return tuple(step for step, _ in _measured(flight))


@lru_cache(maxsize=1)  # ten metrics and the verdict ask for the same flight
def _measured(flight: Flight) -> list[tuple[Step, bool]]:
    """Measure all responses of a flight, in order, and say which ones are those to steps."""
    stamps, setpoints = flight.control["stamp_ns"], flight.control["setpoint"]
    if flight.end_ns is None or not len(stamps):
        return []
    changed = (np.diff(setpoints, axis=0) != 0).any(axis=1)
    begins = np.append(0, np.flatnonzero(changed) + 1)
    begins_ns = stamps[begins]
    ends_ns = np.append(begins_ns[1:], flight.end_ns)
    before = begins_ns.searchsorted(begins_ns - SHORTEST_NS)
    is_step = np.arange(len(begins)) - before < JUMP_MAX
    # In its last period, a mission may already have the setpoint of the stop, which is no waypoint.
    last = np.flatnonzero(flight.control["waypoint"][begins] >= 0).max(initial=0)
    is_cut = flight.ending is None or flight.ending[1] not in ENDS_STEP
    found = []
    before_ns = stamps[np.maximum(begins - 1, 0)]  # the step may have begun since then
    before_ns[0] = min(flight.start_ns or 0, stamps[0])
    for number in np.flatnonzero(ends_ns - begins_ns >= SHORTEST_NS):
        span = int(before_ns[number]), int(ends_ns[number])
        if any(hole.meets(*span) for hole in flight.holes):
            continue
        cut = is_cut and bool(number >= last)
        response = _measure(flight, int(begins[number]), int(ends_ns[number]), cut=cut)
        if response is not None:
            found.append((response, bool(is_step[number])))
    return found


def _measure(flight: Flight, row: int, end_ns: int, *, cut: bool) -> Step | None:
    """Measure the response to the setpoint in `row`, until `end_ns` [ns]; None for a tiny step.

    `cut` is True if the step has no end of its own.
    """
    control = flight.control
    begin_ns, setpoint = int(control["stamp_ns"][row]), control["setpoint"][row]
    truth = between(flight.truth, begin_ns, end_ns - 1)
    times = (truth["stamp_ns"] - begin_ns) * 1e-9
    errors = truth["position"] - setpoint
    sizes = np.linalg.norm(errors, axis=1)
    length = float(sizes[0]) if len(sizes) else 0.0
    if length < LENGTH_MIN:
        return None
    # Share of the way along the straight line from the start to the setpoint.
    share = 1.0 - (errors * errors[0]).sum(axis=1) / length**2
    commands = (control["stamp_ns"] >= begin_ns) & (control["stamp_ns"] < end_ns)
    speeds = np.linalg.norm(control["command"][commands], axis=1)
    sent = (control["stamp_ns"][commands] - begin_ns) * 1e-9
    late = truth["stamp_ns"] >= end_ns - SHORTEST_NS
    return Step(
        waypoint=int(control["waypoint"][row]),
        start=float(flight.seconds(begin_ns)),
        length=length,
        overshoot=max(0.0, float(share.max()) - 1.0),
        rise_time=_rise_time(times, share),
        settling_time=None if cut else _settling_time(times, sizes, BAND * length),
        iae=_integral(sizes, times),
        ise=_integral(sizes**2, times),
        squared_command=_integral(speeds**2, sent),
        last_error=float(sizes[late].max(initial=0.0)),
        unstable=any(_grows(errors[:, axis]) for axis in range(3)),
        cut=cut,
    )


def _integral(values: Array, times: Array) -> float:
    """Integrate `values` over `times` [s] by the trapezoidal rule.

    `numpy.trapezoid` needs numpy 2. The last bit of a product by `@` depends on the addresses of
    the arrays. Therefore the function uses neither.
    """
    return float(((values[1:] + values[:-1]) / 2 * np.diff(times)).sum())


def _rise_time(times: Array, share: Array) -> float | None:
    low, high = (times[share >= bound] for bound in RISE)
    return float(high[0] - low[0]) if len(high) else None


def _settling_time(times: Array, sizes: Array, band: float) -> float | None:
    outside = np.flatnonzero(differences(band, sizes) > 0.0)
    if not len(outside):
        return 0.0
    return float(times[outside[-1] + 1]) if outside[-1] + 1 < len(times) else None


def _grows(error: Array) -> bool:
    """Return whether `error`, along one axis [m], shape (n,), oscillates without decay.

    A half-wave is the error between two changes of sign; the first half-wave begins
    at the first change. The error does not decay if a half-wave is larger than `GROWTH_MIN`, and at
    least as large as the previous half-wave of the same sign.
    """
    crossings = np.flatnonzero(np.signbit(error[1:]) != np.signbit(error[:-1])) + 1
    waves = np.split(np.abs(error), crossings)[1:]
    peaks = [float(wave.max()) for wave in waves if len(wave)]
    return any(
        not exceeds(earlier, later) and exceeds(later, GROWTH_MIN)
        for earlier, later in zip(peaks, peaks[2:], strict=False)
    )


def _mean_of(flight: Flight, name: str) -> float | None:
    values = [getattr(step, name) for step in steps(flight)]
    return mean(np.array([value for value in values if value is not None], dtype=float))


def _tracking_errors(flight: Flight) -> Array:
    errors = tracking_errors(flight, flight.true_position(flight.control["stamp_ns"]))
    return np.asarray(np.linalg.norm(errors, axis=1))


def _control_cost(flight: Flight) -> float | None:
    """Integrate the squared distance from setpoint to true position over the mission [m^2 s].

    It is the quadratic cost of networked control, x'Qx + u'Ru, with Q = 1 for this distance and
    R = 0: a moving setpoint asks for a velocity, so a velocity costs nothing. The time in which the
    robot waits for its first command counts, because the network makes it longer.
    Source: L. Schenato, B. Sinopoli, M. Franceschetti, K. Poolla, S. S. Sastry, "Foundations of
    control and estimation over lossy networks", Proceedings of the IEEE 95 (1), 2007.
    """
    if flight.mission_ns is None or flight.end_ns is None:
        return None
    rows = between(flight.recording["/setpoint_position"].columns, flight.mission_ns, flight.end_ns)
    errors = rows["setpoint"] - flight.true_position(rows["stamp_ns"])
    squares = np.square(errors).sum(axis=1)
    known = np.isfinite(squares)
    times = flight.seconds(rows["stamp_ns"][known])
    return _integral(squares[known], times) if known.any() else None


add_measures(
    ("overshoot_mean", partial(_mean_of, name="overshoot")),
    ("overshoot_max", lambda flight: max((step.overshoot for step in steps(flight)), default=None)),
    ("rise_time_mean", partial(_mean_of, name="rise_time")),
    ("settling_time_mean", partial(_mean_of, name="settling_time")),
    (
        "unsettled_steps",
        lambda flight: flight.count(sum(step.is_unsettled for step in steps(flight))),
    ),
    ("iae_mean", partial(_mean_of, name="iae")),
    ("ise_mean", partial(_mean_of, name="ise")),
    ("squared_command_integral_mean", partial(_mean_of, name="squared_command")),
    (
        "unstable_steps",
        lambda flight: flight.count(sum(step.unstable for step in responses(flight))),
    ),
    ("tracking_error_p95", _tracking_errors, "p95"),
    ("tracking_error_peak", _tracking_errors, "max"),
    ("control_cost", _control_cost),
)
