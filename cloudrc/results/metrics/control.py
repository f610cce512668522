# SPDX-License-Identifier: Apache-2.0

"""Metrics of the control loop: estimation, prediction, tracking, round trips and timing."""

from __future__ import annotations

from functools import lru_cache, partial
from math import inf, sqrt

import numpy as np

from cloudrc.base.rounding import differences
from cloudrc.results.metrics.age import Ages, describe, most_missed, sawtooth
from cloudrc.results.metrics.definitions import (
    GAP_MAX_NS,
    age,
    delay_error,
    prediction_error,
    real_time_factor,
    tracking_error,
)
from cloudrc.results.metrics.flight import (
    Array,
    Columns,
    Flight,
    add_measures,
    finite,
    mean,
    rms,
    select,
)
from cloudrc.results.record.columns import datagrams, join
from cloudrc.wire.messages import FRESH_ECHO_PERIODS, NEVER_NS, GuardState


@lru_cache(maxsize=1)  # four metrics and the figures ask for the same flight
def _echoes(flight: Flight) -> Columns:
    """Measure the loop with each telemetry that cloud used, in order of arrival.

    Returns:
        `stamp_ns` of the arrival [ns]; `loop_delay`, from the newest applied command to this
        arrival [s]; `rtt`, the same without the hold time in world [s]; `is_first`, whether no
        earlier row is about the same command; `is_sample`, whether the estimator got the row.
    """
    applied, estimates = flight.recording["/command_applied"], flight.recording["/delay_estimate"]
    telemetry, arrivals = flight.recording["/telemetry"], flight.during("/uplink_delay")
    is_echo = telemetry["echo_stamp_ns"] != NEVER_NS
    sent_ns, held_ns = (telemetry[name][is_echo] for name in ("stamp_ns", "echo_hold_ns"))
    used = select(arrivals, arrivals["used"])
    arrived, echo = join(datagrams(used), datagrams(telemetry)[is_echo])
    # The stamp in an echo may be on another clock than the recording: the time of application,
    # world's clock, tells the command.
    echoed, command = join((sent_ns - held_ns)[echo], applied["stamp_ns"])
    numbers = datagrams(applied)[command]
    rows, made = join(numbers, datagrams(estimates))
    echoed = echoed[rows]
    stamps_ns, held_ns = used["stamp_ns"][arrived[echoed]], held_ns[echo[echoed]]
    loops_ns = stamps_ns - estimates["stamp_ns"][made]
    is_first = np.zeros(len(rows), dtype=bool)
    is_first[np.unique(numbers[rows], return_index=True)[1]] = True
    return {
        "stamp_ns": stamps_ns,
        "loop_delay": loops_ns * 1e-9,
        "rtt": (loops_ns - held_ns) * 1e-9,
        "is_first": is_first,
        "is_sample": held_ns <= FRESH_ECHO_PERIODS * round(1e9 / flight.command_rate_hz),
    }


def round_trips(flight: Flight) -> Columns:
    """Measure the round trip of each applied command whose echo arrived: its first in `_echoes`."""
    rows = _echoes(flight)
    return select(rows, rows["is_first"])


def estimator_samples(flight: Flight) -> Columns:
    """Return the rows of `_echoes` that the estimator got as samples."""
    rows = _echoes(flight)
    return select(rows, rows["is_sample"])


def _age_of_information(flight: Flight) -> float | None:
    """Compute the mean age of the odometry that cloud used [s]; None without a shared clock."""
    if not np.isfinite(flight.during("/uplink_delay")["delay"]).any():
        return None
    return mean(age(flight.control["stamp_ns"], flight.control["basis_stamp_ns"]))


def _command_in_use(flight: Flight, at_ns: Array) -> Array:
    """Return the row of the command that the robot follows at each instant [ns]; -1: none."""
    applied, guard = flight.during("/command_applied"), flight.during("/guard")
    newest = applied["stamp_ns"].searchsorted(at_ns, "right") - 1
    state = guard["state"][guard["stamp_ns"].searchsorted(at_ns, "right") - 1]
    return np.where(state == GuardState.TRACK, newest, -1)


@lru_cache(maxsize=1)  # five metrics and a figure ask for the same flight
def ages_at_actuator(flight: Flight) -> Ages:
    """Compute the age of information at the actuator: of the odometry behind the command in use.

    World's clock alone gives it. While no command is in use, as in HOLD, there is no age.
    """
    applied, changes = flight.during("/command_applied"), flight.during("/guard")["stamp_ns"]
    stamps_ns = applied["stamp_ns"]
    if not len(stamps_ns):
        return Ages(*np.zeros((4, 0)))
    edges_ns = np.unique(np.concatenate([stamps_ns, changes, [flight.end_ns]]))
    edges_ns = edges_ns[edges_ns >= stamps_ns[0]]
    ages = sawtooth(edges_ns, stamps_ns, applied["basis_stamp_ns"])
    in_use = _command_in_use(flight, ages.begin_ns) >= 0
    return Ages(*(column[in_use] for column in ages))


def _age(name: str, flight: Flight) -> float | None:
    return describe(ages_at_actuator(flight), flight.criteria.age_deadline_s).get(name)


def _most_missed(flight: Flight) -> float | None:
    """Count missed command periods: those that begin without a command in use, or with a late one.

    Only with a deadline, a command can be late.
    """
    if flight.span_ns is None:
        return None
    steps_ns = np.arange(*flight.span_ns, round(1e9 / flight.command_rate_hz))
    used = _command_in_use(flight, steps_ns)
    bases_ns = np.append(flight.during("/command_applied")["basis_stamp_ns"], NEVER_NS)[used]
    limit = flight.criteria.age_deadline_s or inf
    return float(most_missed((used < 0) | (differences(limit, age(steps_ns, bases_ns)) > 0.0)))


def compare_with_truth(
    flight: Flight, at_ns: Array, predicted: Array
) -> tuple[float | None, Array, Array]:
    """Compare predicted positions with the true position at the same instants.

    Args:
        flight: The flight.
        at_ns: Instants on world's clock [ns], shape (n,).
        predicted: Predicted positions [m], shape (n, 3).

    Returns:
        The root mean square length of all errors [m], None without one. Then, of the predictions
        that could be compared, the instants [ns], shape (m,), and the errors [m], shape (m, 3).
    """
    truth = flight.recording["/ground_truth"]
    stamps_ns, positions = truth["stamp_ns"], truth["position"]
    known = np.isfinite(predicted).all(axis=1)  # a plug-in's model may have predicted NaN
    at_ns, predicted = at_ns[known], predicted[known]
    order = np.lexsort((*predicted.T[::-1], at_ns))
    at_ns, predicted = at_ns[order], predicted[order]
    # An instant that has the stamp of a row is judged with the row before.
    after = stamps_ns.searchsorted(at_ns)
    inside = (after > 0) & (after < len(stamps_ns))
    inside[inside] = np.diff(stamps_ns)[after[inside] - 1] <= GAP_MAX_NS
    at_ns, predicted, after = at_ns[inside], predicted[inside], after[inside]
    before = after - 1
    share = (at_ns - stamps_ns[before]) / (stamps_ns[after] - stamps_ns[before])
    error = prediction_error(predicted.T, positions[before].T, positions[after].T, share)
    errors = np.stack(error, axis=1)
    squares = sum(axis * axis for axis in error)
    rms = sqrt(np.cumsum(squares)[-1] / len(at_ns)) if len(at_ns) else None  # in the order of time
    return rms, at_ns, errors


def _has_plans(flight: Flight) -> bool:
    """Whether a command that world applied in the flight had a plan of future velocities."""
    return bool((flight.during("/command_applied")["planned_ns"] >= 0).any())


def prediction_errors(flight: Flight) -> tuple[float | None, Array, Array]:
    """Compare each predicted position with the true position when the command was applied.

    So an error of the estimated delay adds to the result, which is that of `compare_with_truth`.
    With plans, compare the position that the plan in use had predicted, at each odometry.
    Source: docs/reference/control.md, "Predictors".
    """
    if _has_plans(flight):
        plans = flight.during("/plan")
        return compare_with_truth(flight, plans["basis_stamp_ns"], plans["position"])
    return compare_with_truth(flight, flight.applied["stamp_ns"], flight.applied["position"])


def estimate_errors(flight: Flight) -> tuple[float | None, Array, Array]:
    """Compare each predicted position with the true position at the instant of the prediction.

    Live metrics show these errors, too, but against the measured position (`PredictionJudge`).
    The result is that of `compare_with_truth`.
    """
    control = flight.control
    at_ns = control["basis_stamp_ns"] + np.rint(control["horizon"] * 1e9).astype(np.int64)
    return compare_with_truth(flight, at_ns, control["position"])


def _delay_error(flight: Flight) -> float | None:
    """Compute the RMS difference between estimated (horizon) and true delay of the commands [s].

    Commands before the first measured round trip are left out. None with plans: the horizon is then
    the time at which the plan begins by definition, whenever the command arrives.
    """
    applied = flight.applied
    if _has_plans(flight):
        return None
    errors = delay_error(applied["horizon"], applied["basis_stamp_ns"], applied["stamp_ns"])
    return rms(errors[np.isfinite(applied["rtt"])])


def tracking_errors(flight: Flight, position: Array) -> Array:
    """Return setpoint minus `position` [m], one row per control period, both of shape (n, 3)."""
    return np.stack(tracking_error(flight.control["setpoint"].T, position.T), axis=1)


def wakes(flight: Flight, end: str) -> Columns:
    """Return how late `end` ("world" or "cloud") woke up: its rows of the topic /lateness.

    There are no rows in virtual time.
    """
    columns = flight.during("/lateness")
    return select(columns, columns["end"] == end)


def _slip(flight: Flight) -> float | None:
    slips = wakes(flight, "world")["slip_ns"]
    return float(slips[-1] - slips[0]) * 1e-9 if len(slips) else None


def _real_time_factor(flight: Flight) -> float | None:
    columns = wakes(flight, "world")
    if not len(columns["stamp_ns"]):
        return None
    passed_ns, slip_ns = (int(np.ptp(columns[name])) for name in ("stamp_ns", "slip_ns"))
    return finite(real_time_factor(passed_ns, slip_ns))


def _missed_periods(flight: Flight) -> float | None:
    if not len(flight.recording["/lateness"]):
        return None
    return flight.growth("missed_periods") or 0.0


add_measures(
    ("rtt_mean", lambda flight: round_trips(flight)["rtt"], "mean"),
    ("rtt_p95", lambda flight: round_trips(flight)["rtt"], "p95"),
    ("loop_delay_mean", lambda flight: round_trips(flight)["loop_delay"], "mean"),
    ("delay_sample_mean", lambda flight: estimator_samples(flight)["loop_delay"], "mean"),
    ("age_of_information_mean", _age_of_information),
    ("age_at_actuator_mean", partial(_age, "mean")),
    ("age_at_actuator_p99", partial(_age, "p99")),
    ("age_at_actuator_max", partial(_age, "max")),
    ("peak_age_mean", partial(_age, "peak_mean")),
    ("age_violation", partial(_age, "violation")),
    ("misses_in_10", _most_missed),
    (
        "commands_applied",
        lambda flight: flight.count(len(flight.during("/command_applied")["epoch"])),
    ),
    ("commands_withheld", lambda flight: flight.growth("commands_withheld")),
    ("prediction_error_rms", lambda flight: prediction_errors(flight)[0]),
    ("estimate_error_rms", lambda flight: estimate_errors(flight)[0]),
    ("delay_estimate_error_rms", _delay_error),
    ("world_lateness_p99", lambda flight: wakes(flight, "world")["lateness"], "p99"),
    ("cloud_lateness_p99", lambda flight: wakes(flight, "cloud")["lateness"], "p99"),
    ("world_slip", _slip),
    ("real_time_factor", _real_time_factor),
    ("missed_periods", _missed_periods),
    ("controller_gaps", lambda flight: flight.growth("controller_gaps")),
)
