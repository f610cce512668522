"""Metrics of the control loop: estimation, prediction, tracking, round trips, and real time."""

from __future__ import annotations

from functools import partial

import numpy as np

from cloudrc.metrics.flight import Array, Flight, Metric, mean, percentile, rms


def round_trips(flight: Flight) -> dict[str, Array]:
    """Select the control periods with a new echo.

    A period without a new echo repeats the previous values. Counting such periods would give too
    much weight to a silent downlink, during which the last echo repeats for seconds.
    """
    control = flight.control
    pair = np.stack([control["rtt"], control["loop_delay"]], axis=1)
    new = np.ones(len(pair), dtype=bool)
    new[1:] = (pair[1:] != pair[:-1]).any(axis=1)
    return {name: column[new] for name, column in control.items()}


def _rtt_mean(flight: Flight) -> float | None:
    """Average over all echoes.

    Only applied commands have an echo. If the newest command wins, the applied commands are the
    fast ones, so that the mean is below the round trip of the link profile. Use the one-way delays
    to judge the link itself.
    """
    return mean(round_trips(flight)["rtt"])


def _rtt_p95(flight: Flight) -> float | None:
    return percentile(round_trips(flight)["rtt"], 95.0)


def _loop_delay_mean(flight: Flight) -> float | None:
    return mean(round_trips(flight)["loop_delay"])


def _age_of_information_mean(flight: Flight) -> float | None:
    """Average the age of the odometry over all control periods.

    Return None unless both ends prove that they share a clock; only then are one-way delays
    recorded.
    """
    if not np.isfinite(flight.during("/uplink_delay")["delay"]).any():
        return None
    return mean((flight.control["stamp_ns"] - flight.control["basis_stamp_ns"]) * 1e-9)


def _commands_applied(flight: Flight) -> float | None:
    if flight.start_ns is None:
        return None
    return float(len(flight.during("/command_applied")["epoch"]))


def _prediction_error_rms(flight: Flight) -> float | None:
    """Compare the predicted with the true position at the application of each command.

    The error contains the error of the predictor and the error of the delay estimate: a command
    acts when it is applied, even if it was computed for another instant.

    Source: docs/reference/control.md, "Predictors".
    """
    applied = flight.applied
    return rms(applied.predicted - flight.true_position(applied.stamp_ns))


def _estimate_error_rms(flight: Flight) -> float | None:
    """Compare the estimated with the true position, over all control periods.

    This is the error of the predictor alone: both positions are for the odometry's stamp plus the
    horizon, even if the horizon is wrong.
    """
    control = flight.control
    target_ns = control["basis_stamp_ns"] + np.rint(control["horizon"] * 1e9).astype(np.int64)
    return rms(control["position"] - flight.true_position(target_ns))


def _delay_estimate_error_rms(flight: Flight) -> float | None:
    """Compare the horizon with the true delay, over all applied commands.

    The true delay is the time from the odometry to the first tick of the low-level controller that
    uses the command, on world's clock.
    """
    applied = flight.applied
    return rms(applied.horizon - (applied.stamp_ns - applied.basis_stamp_ns) * 1e-9)


def _tracking_rms(flight: Flight, column: str) -> float | None:
    """Compare the setpoint with a position that cloud knows, over all control periods.

    The distance to the next waypoint dominates this number. The metric estimate_error_rms shows the
    accuracy of the estimate.

    Source: the paper, error figure.
    """
    return rms(flight.control["setpoint"] - flight.control[column])


def wakes(flight: Flight, end: str) -> dict[str, Array]:
    """Select the rows of /lateness that one end recorded during the flight.

    Args:
        flight: A flight of any mode; in virtual time there are no such rows.
        end: "world" or "cloud".
    """
    columns = flight.during("/lateness")
    rows = columns["end"] == end
    return {name: column[rows] for name, column in columns.items()}


def _lateness_p99(flight: Flight, end: str) -> float | None:
    return percentile(wakes(flight, end)["lateness"], 99.0)


def _world_slip(flight: Flight) -> float | None:
    """Subtract the slip at the start of the flight from the slip at its end."""
    slips = wakes(flight, "world")["slip_ns"]
    return float(slips[-1] - slips[0]) * 1e-9 if len(slips) else None


def _real_time_factor(flight: Flight) -> float | None:
    """Divide simulated time by simulated time plus slip.

    The factor must be close to 1. Below 1 the simulated robot was slower than the network.
    """
    slipped = _world_slip(flight)
    if slipped is None or not flight.end_ns:
        return None
    simulated = float(flight.seconds(flight.end_ns))
    return simulated / (simulated + slipped) if simulated > 0 else None


def _missed_periods(flight: Flight) -> float | None:
    """Return cloud's last count of missed periods; None in virtual time."""
    if not len(flight.recording["/lateness"]):
        return None
    count = flight.recording["/count"]
    missed = count["total"][count["name"] == "missed_periods"]
    return float(missed[-1]) if len(missed) else 0.0


METRICS = (
    Metric(
        "rtt_mean",
        "s",
        "Mean round trip from command to echo, without the hold time in world.",
        _rtt_mean,
    ),
    Metric(
        "rtt_p95",
        "s",
        "Round trip from command to echo, without the hold time in world: 95th percentile.",
        _rtt_p95,
    ),
    Metric(
        "loop_delay_mean",
        "s",
        "Mean round trip from command to echo, with the hold time in world: the paper's tau_n.",
        _loop_delay_mean,
    ),
    Metric(
        "age_of_information_mean",
        "s",
        "Mean age of cloud's newest odometry when it computes a command.",
        _age_of_information_mean,
    ),
    Metric(
        "commands_applied",
        "1",
        "Number of commands that reached the low-level controller.",
        _commands_applied,
    ),
    Metric(
        "prediction_error_rms",
        "m",
        "RMS distance between cloud's predicted position and the true position when the command "
        "was applied.",
        _prediction_error_rms,
    ),
    Metric(
        "estimate_error_rms",
        "m",
        "RMS distance between cloud's predicted position and the true position at the instant for "
        "which cloud predicted it.",
        _estimate_error_rms,
    ),
    Metric(
        "delay_estimate_error_rms",
        "s",
        "RMS difference between the horizon and the true delay from odometry to applied command.",
        _delay_estimate_error_rms,
    ),
    Metric(
        "tracking_rms_measured",
        "m",
        "RMS distance between the setpoint and the measured position that cloud used.",
        partial(_tracking_rms, column="measured"),
    ),
    Metric(
        "tracking_rms_estimated",
        "m",
        "RMS distance between the setpoint and cloud's estimated position.",
        partial(_tracking_rms, column="position"),
    ),
    *(
        Metric(
            f"{end}_lateness_p99",
            "s",
            f"Lateness of {end}'s wakes: 99th percentile; real time only.",
            partial(_lateness_p99, end=end),
        )
        for end in ("world", "cloud")
    ),
    Metric(
        "world_slip",
        "s",
        "Time that world's clock lost against the machine's clock because the simulation was late.",
        _world_slip,
    ),
    Metric(
        "real_time_factor",
        "1",
        "Simulated time divided by time on the machine's clock; real time only.",
        _real_time_factor,
    ),
    Metric(
        "missed_periods",
        "1",
        "Number of 10 ms periods without a command because cloud was late; real time only.",
        _missed_periods,
    ),
)
