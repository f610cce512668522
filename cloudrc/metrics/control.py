"""Metrics of the control loop: estimates, predictions, tracking, round trips, and real time."""

from __future__ import annotations

from functools import partial

import numpy as np

from cloudrc.metrics.flight import Array, Flight, Metric, mean, percentile, rms


def round_trips(flight: Flight) -> dict[str, Array]:
    """Take the control periods in which a new echo had come in.

    A period without an echo repeats the values of the period before. To count it would give the
    most weight to a silent downlink, whose last echo is repeated for seconds.
    """
    control = flight.control
    pair = np.stack([control["rtt"], control["loop_delay"]], axis=1)
    new = np.ones(len(pair), dtype=bool)
    new[1:] = (pair[1:] != pair[:-1]).any(axis=1)
    return {name: column[new] for name, column in control.items()}


def _rtt_mean(flight: Flight) -> float | None:
    """Average over the echoes.

    It describes the commands that were applied. With newest-wins these are the quick ones, so it
    reads lower than the link profile; the one-way delays judge the link itself.
    """
    return mean(round_trips(flight)["rtt"])


def _rtt_p95(flight: Flight) -> float | None:
    return percentile(round_trips(flight)["rtt"], 95.0)


def _loop_delay_mean(flight: Flight) -> float | None:
    return mean(round_trips(flight)["loop_delay"])


def _age_of_information_mean(flight: Flight) -> float | None:
    """Average now minus the odometry's stamp over all control periods.

    It is known only if both ends prove that they share a clock, which the one-way delays show.
    """
    if not np.isfinite(flight.during("/uplink_delay")["delay"]).any():
        return None
    return mean((flight.control["stamp_ns"] - flight.control["basis_stamp_ns"]) * 1e-9)


def _commands_applied(flight: Flight) -> float | None:
    if flight.start_ns is None:
        return None
    return float(len(flight.during("/command_applied")["epoch"]))


def _prediction_error_rms(flight: Flight) -> float | None:
    """Compare the predicted with the true position, over all commands applied.

    It judges the predictor and the delay estimate together: a command acts at the instant of its
    application, whatever instant it was computed for.

    Source: docs/reference/control.md, "Predictors".
    """
    applied = flight.applied
    return rms(applied.predicted - flight.true_position(applied.stamp_ns))


def _estimate_error_rms(flight: Flight) -> float | None:
    """Compare the estimated with the true position, over all control periods.

    It judges the predictor alone: the instant meant is the odometry's stamp plus the horizon,
    right or wrong.
    """
    control = flight.control
    meant_ns = control["basis_stamp_ns"] + np.rint(control["horizon"] * 1e9).astype(np.int64)
    return rms(control["position"] - flight.true_position(meant_ns))


def _delay_estimate_error_rms(flight: Flight) -> float | None:
    """Compare the horizon with the time that passed, over all commands applied.

    That time runs from the measurement to the first tick of the low-level controller that uses
    the command, all on world's clock.
    """
    applied = flight.applied
    return rms(applied.horizon - (applied.stamp_ns - applied.basis_stamp_ns) * 1e-9)


def _tracking_rms(flight: Flight, column: str) -> float | None:
    """Compare the setpoint with a position of cloud, over all control periods.

    The distance to the next waypoint dominates it; it says nothing about how accurate the estimate
    is: for that read estimate_error_rms.

    Source: the paper, error figure.
    """
    return rms(flight.control["setpoint"] - flight.control[column])


def wakes(flight: Flight, end: str) -> dict[str, Array]:
    """Take the rows of /lateness that one end recorded during the flight.

    Args:
        flight: Of any mode; a recording of virtual time has no such rows.
        end: "world" or "cloud".
    """
    columns = flight.during("/lateness")
    rows = columns["end"] == end
    return {name: column[rows] for name, column in columns.items()}


def _lateness_p99(flight: Flight, end: str) -> float | None:
    return percentile(wakes(flight, end)["lateness"], 99.0)


def _world_slip(flight: Flight) -> float | None:
    """Subtract the slip at the start from the slip at the end."""
    slips = wakes(flight, "world")["slip_ns"]
    return float(slips[-1] - slips[0]) * 1e-9 if len(slips) else None


def _real_time_factor(flight: Flight) -> float | None:
    """Divide simulated time by simulated time plus slip.

    It has to be 1. Below 1 the simulated robot was slower than the network that it was flown over.
    """
    slipped = _world_slip(flight)
    if slipped is None or not flight.end_ns:
        return None
    simulated = float(flight.seconds(flight.end_ns))
    return simulated / (simulated + slipped) if simulated > 0 else None


def _missed_periods(flight: Flight) -> float | None:
    """Take the last count of cloud; None in virtual time, in which nothing takes time."""
    if not len(flight.recording["/lateness"]):
        return None
    count = flight.recording["/count"]
    missed = count["total"][count["name"] == "missed_periods"]
    return float(missed[-1]) if len(missed) else 0.0


METRICS = (
    Metric(
        "rtt_mean",
        "s",
        "Round trip from command to echo, the time that world held the command excluded: mean.",
        _rtt_mean,
    ),
    Metric(
        "rtt_p95", "s", "Round trip from command to echo, hold excluded: 95th percentile.", _rtt_p95
    ),
    Metric(
        "loop_delay_mean",
        "s",
        "Round trip from command to echo, hold included: mean of the paper's tau_n.",
        _loop_delay_mean,
    ),
    Metric(
        "age_of_information_mean",
        "s",
        "Age of the newest odometry that cloud has when it computes a command: mean.",
        _age_of_information_mean,
    ),
    Metric(
        "commands_applied",
        "1",
        "How many commands reached the low-level controller.",
        _commands_applied,
    ),
    Metric(
        "prediction_error_rms",
        "m",
        "Distance between where cloud expected the robot and where it was when the command was "
        "applied.",
        _prediction_error_rms,
    ),
    Metric(
        "estimate_error_rms",
        "m",
        "Distance between cloud's estimate and the true position at the instant that it is meant "
        "for.",
        _estimate_error_rms,
    ),
    Metric(
        "delay_estimate_error_rms",
        "s",
        "Difference between the horizon and the time that really passed until the command was "
        "applied.",
        _delay_estimate_error_rms,
    ),
    Metric(
        "tracking_rms_measured",
        "m",
        "Distance between the setpoint and the measurement that cloud used: RMS.",
        partial(_tracking_rms, column="measured"),
    ),
    Metric(
        "tracking_rms_estimated",
        "m",
        "Distance between the setpoint and cloud's own estimate: RMS.",
        partial(_tracking_rms, column="position"),
    ),
    *(
        Metric(
            f"{end}_lateness_p99",
            "s",
            f"How late {end}'s process woke up for its deadlines: 99th percentile; real time only.",
            partial(_lateness_p99, end=end),
        )
        for end in ("world", "cloud")
    ),
    Metric(
        "world_slip",
        "s",
        "How much time world's clock lost against its machine's because the simulation was late.",
        _world_slip,
    ),
    Metric(
        "real_time_factor",
        "1",
        "Time that passed in the simulation by time that passed on the machine; real time only.",
        _real_time_factor,
    ),
    Metric(
        "missed_periods",
        "1",
        "How many periods of 10 ms cloud let pass without a command, being busy; real time only.",
        _missed_periods,
    ),
)
