"""Metrics of the control loop: estimation, prediction, tracking, round trips, and real time."""

from __future__ import annotations

import numpy as np

from cloudrc.metrics.flight import Columns, Flight, mean, metric, percentile, rms


def round_trips(flight: Flight) -> Columns:
    """Select the control periods with a new echo.

    A period without a new echo repeats the previous values. Counting such periods would give too
    much weight to a silent downlink, during which the last echo repeats for seconds.
    """
    control = flight.control
    pair = np.stack([control["rtt"], control["loop_delay"]], axis=1)
    new = np.ones(len(pair), dtype=bool)
    new[1:] = (pair[1:] != pair[:-1]).any(axis=1)
    return {name: column[new] for name, column in control.items()}


@metric("s")
def rtt_mean(flight: Flight) -> float | None:
    """Mean round trip from command to echo, without the hold time in world.

    Only applied commands have an echo, and these are the fast ones if the newest command wins.
    """
    return mean(round_trips(flight)["rtt"])


@metric("s")
def rtt_p95(flight: Flight) -> float | None:
    """Round trip from command to echo, without the hold time in world: 95th percentile."""
    return percentile(round_trips(flight)["rtt"], 95.0)


@metric("s")
def loop_delay_mean(flight: Flight) -> float | None:
    """Mean round trip from command to echo, with the hold time in world: the paper's tau_n."""
    return mean(round_trips(flight)["loop_delay"])


@metric("s")
def age_of_information_mean(flight: Flight) -> float | None:
    """Mean age of cloud's newest odometry when it computes a command.

    None unless both ends prove that they share a clock; only then one-way delays are recorded.
    """
    if not np.isfinite(flight.during("/uplink_delay")["delay"]).any():
        return None
    return mean((flight.control["stamp_ns"] - flight.control["basis_stamp_ns"]) * 1e-9)


@metric("1")
def commands_applied(flight: Flight) -> float | None:
    """Number of commands that reached the low-level controller."""
    if flight.start_ns is None:
        return None
    return float(len(flight.during("/command_applied")["epoch"]))


@metric("m")
def prediction_error_rms(flight: Flight) -> float | None:
    """RMS distance from the predicted to the true position when each command was applied.

    It contains the error of the delay estimate. Source: docs/reference/control.md, "Predictors".
    """
    applied = flight.applied
    return rms(applied["position"] - flight.true_position(applied["stamp_ns"]))


@metric("m")
def estimate_error_rms(flight: Flight) -> float | None:
    """RMS distance from the predicted to the true position at the instant of the prediction.

    This is the error of the predictor alone, even if the horizon is wrong.
    """
    control = flight.control
    target_ns = control["basis_stamp_ns"] + np.rint(control["horizon"] * 1e9).astype(np.int64)
    return rms(control["position"] - flight.true_position(target_ns))


@metric("s")
def delay_estimate_error_rms(flight: Flight) -> float | None:
    """RMS difference between the horizon and the true delay from odometry to applied command."""
    applied = flight.applied
    return rms(applied["horizon"] - (applied["stamp_ns"] - applied["basis_stamp_ns"]) * 1e-9)


@metric("m")
def tracking_rms_measured(flight: Flight) -> float | None:
    """RMS distance between the setpoint and the measured position that cloud used."""
    return rms(flight.control["setpoint"] - flight.control["measured"])


@metric("m")
def tracking_rms_estimated(flight: Flight) -> float | None:
    """RMS distance between the setpoint and cloud's estimated position."""
    return rms(flight.control["setpoint"] - flight.control["position"])


def wakes(flight: Flight, end: str) -> Columns:
    """Select the rows of /lateness that "world" or "cloud" recorded; none in virtual time."""
    columns = flight.during("/lateness")
    rows = columns["end"] == end
    return {name: column[rows] for name, column in columns.items()}


@metric("s")
def world_lateness_p99(flight: Flight) -> float | None:
    """Lateness of world's wakes: 99th percentile; real time only."""
    return percentile(wakes(flight, "world")["lateness"], 99.0)


@metric("s")
def cloud_lateness_p99(flight: Flight) -> float | None:
    """Lateness of cloud's wakes: 99th percentile; real time only."""
    return percentile(wakes(flight, "cloud")["lateness"], 99.0)


@metric("s")
def world_slip(flight: Flight) -> float | None:
    """Time that world's clock lost on the machine's clock because the simulation was late."""
    slips = wakes(flight, "world")["slip_ns"]
    return float(slips[-1] - slips[0]) * 1e-9 if len(slips) else None


@metric("1")
def real_time_factor(flight: Flight) -> float | None:
    """Simulated time divided by time on the machine's clock; real time only."""
    slipped = world_slip(flight)
    if slipped is None or not flight.end_ns:
        return None
    simulated = float(flight.seconds(flight.end_ns))
    return simulated / (simulated + slipped) if simulated > 0 else None


@metric("1")
def missed_periods(flight: Flight) -> float | None:
    """Number of 10 ms periods without a command because cloud was late; real time only."""
    if not len(flight.recording["/lateness"]):
        return None
    count = flight.recording["/count"]
    missed = count["total"][count["name"] == "missed_periods"]
    return float(missed[-1]) if len(missed) else 0.0
