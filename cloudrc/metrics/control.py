"""Metrics of the control loop: estimation, prediction, tracking, round trips and timing."""

from __future__ import annotations

import numpy as np

from cloudrc.metrics.flight import Columns, Flight, add_metrics, mean, percentile, rms, select


def round_trips(flight: Flight) -> Columns:
    """Select the control periods in which cloud measured a new round trip.

    All other periods repeat the last measured values, for seconds on end if the link is silent.
    """
    control = flight.control
    pair = np.stack([control["rtt"], control["loop_delay"]], axis=1)
    new = np.ones(len(pair), dtype=bool)
    new[1:] = (pair[1:] != pair[:-1]).any(axis=1)
    return select(control, new)


def _age_of_information(flight: Flight) -> float | None:
    """Compute the mean age of the odometry that cloud used [s]; None without a shared clock."""
    if not np.isfinite(flight.during("/uplink_delay")["delay"]).any():
        return None
    return mean((flight.control["stamp_ns"] - flight.control["basis_stamp_ns"]) * 1e-9)


def _prediction_error(flight: Flight) -> float | None:
    """Compute the RMS distance from the predicted to the true position of the robot [m].

    The true position is that at the time when the robot applies the command. So an error of the
    estimated delay adds to the result.
    Source: docs/reference/control.md, "Predictors".
    """
    applied = flight.applied
    return rms(applied["position"] - flight.true_position(applied["stamp_ns"]))


def _estimate_error(flight: Flight) -> float | None:
    """Compute the RMS distance [m] from predicted to true positions at the predicted times."""
    control = flight.control
    target_ns = control["basis_stamp_ns"] + np.rint(control["horizon"] * 1e9).astype(np.int64)
    return rms(control["position"] - flight.true_position(target_ns))


def _delay_error(flight: Flight) -> float | None:
    """Compute the RMS difference between estimated (horizon) and true delay of the commands [s].

    Commands before the first measured round trip are left out.
    """
    applied = flight.applied
    errors = applied["horizon"] - (applied["stamp_ns"] - applied["basis_stamp_ns"]) * 1e-9
    return rms(errors[np.isfinite(applied["rtt"])])


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
    slipped = _slip(flight)
    if slipped is None or flight.duration <= 0.0:
        return None
    return flight.duration / (flight.duration + slipped)


def _missed_periods(flight: Flight) -> float | None:
    if not len(flight.recording["/lateness"]):
        return None
    return flight.last_total("missed_periods") or 0.0


add_metrics(
    "Link and loop",
    ("rtt_mean", "s", "Mean round trip from command to echo, without the hold time in world.",
     lambda flight: mean(round_trips(flight)["rtt"])),
    ("rtt_p95", "s", "Round trip from command to echo, without the hold time in world: 95th "
     "percentile.", lambda flight: percentile(round_trips(flight)["rtt"], 95.0)),
    ("loop_delay_mean", "s", "Mean round trip from command to echo, with the hold time in world: "
     "the paper's tau_n.", lambda flight: mean(round_trips(flight)["loop_delay"])),
    ("age_of_information_mean", "s", "Mean age of cloud's newest odometry when it computes a "
     "command.", _age_of_information),
    ("commands_applied", "1", "Number of commands that reached the low-level controller.",
     lambda flight: flight.count(len(flight.during("/command_applied")["epoch"]))),
)  # fmt: skip
add_metrics(
    "Estimation and tracking",
    ("prediction_error_rms", "m", "RMS distance from the predicted to the true position when each "
     "command was applied.", _prediction_error),
    ("estimate_error_rms", "m", "RMS distance from the predicted to the true position at the "
     "instant of the prediction.", _estimate_error),
    ("delay_estimate_error_rms", "s", "RMS difference between the horizon and the true delay from "
     "odometry to applied command, from the first echo on.", _delay_error),
    ("tracking_rms_measured", "m", "RMS distance between the setpoint and the measured position "
     "that cloud used.",
     lambda flight: rms(flight.control["setpoint"] - flight.control["measured"])),
    ("tracking_rms_estimated", "m", "RMS distance between the setpoint and cloud's estimated "
     "position.", lambda flight: rms(flight.control["setpoint"] - flight.control["position"])),
)  # fmt: skip
add_metrics(
    "Real time",
    ("world_lateness_p99", "s", "Lateness of world's wakes: 99th percentile; real time only.",
     lambda flight: percentile(wakes(flight, "world")["lateness"], 99.0)),
    ("cloud_lateness_p99", "s", "Lateness of cloud's wakes: 99th percentile; real time only.",
     lambda flight: percentile(wakes(flight, "cloud")["lateness"], 99.0)),
    ("world_slip", "s", "Time by which world's clock fell behind the machine's clock because "
     "the simulation was late.", _slip),
    ("real_time_factor", "1", "Simulated time divided by time on the machine's clock; real time "
     "only.", _real_time_factor),
    ("missed_periods", "1", "Number of periods without a command because cloud was late; "
     "real time only.", _missed_periods),
)  # fmt: skip
