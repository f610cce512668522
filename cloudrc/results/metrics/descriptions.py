# SPDX-License-Identifier: Apache-2.0

"""Name, unit and meaning of each metric of cloudrc.

The table stands apart from the functions that measure, because `cloudrc list` needs the table alone
and numpy takes longer to import than the whole list.
"""

from __future__ import annotations

from typing import NamedTuple

from cloudrc.results.metrics.definitions import QUANTITIES


class Description(NamedTuple):
    """What people read about a metric."""

    unit: str  # SI unit as text; "1" for counts and shares
    meaning: str  # one sentence
    group: str  # title above the metric in report.html
    label: str  # in the summary of a report; "": not there


WAYS = {"uplink": "from world to cloud", "downlink": "from cloud to world"}
"""Direction of the link -> words for it in the description of a metric."""
RELEASE_ERRORS = {"p50": "median", "p99": "99th percentile", "p999": "99.9th percentile"}
RELAY_COUNTS = {
    "relay_overflow": "that the relay dropped because its queue was full.",
    # The release errors do not include this time.
    "relay_stalled": "that waited 50 ms or more until the relay read them.",
    "released_early": "that left before they were due; above 0 the relay has a bug.",
}
AGE_STAGES = {
    "observation": "odometry waits for its datagram",
    "uplink_cell": "telemetry passes the cell",
    "uplink_rate": "telemetry waits at the bottleneck",
    "uplink_request": "telemetry waits for a request slot",
    "uplink_grant": "grant and slot of the uplink",
    "uplink_repeat": "repetitions of the uplink",
    "uplink": "uplink",
    "queue": "telemetry waits for cloud's period",
    "compute": "cloud computes",
    "downlink_cell": "command passes the cell",
    "downlink_rate": "command waits at the bottleneck",
    "downlink_grant": "slot of the downlink",
    "downlink_repeat": "repetitions of the downlink",
    "downlink": "downlink",
    "wait": "command waits for the step",
}
"""Stages of the age of a command, in their order -> in words."""
SCAN_STAGES = {
    "frame_encode": "picture is rendered and encoded",
    "scan_uplink": "uplink of the scan or picture",
    "scan_wait": "scan or picture waits for the perception",
    "scan_compute": "perception computes",
    "scan_hold": "setpoint waits for its command",
}
"""Stages from a scan or picture to the first command for it, in their order -> in words."""
DESCRIPTIONS: dict[str, Description] = {}
"""Name in report.json -> description."""


def _add(group: str, *rows: tuple[str, str, str], **labels: str) -> None:
    """Add metrics to a group; each row has name, unit and meaning.

    `labels` are the labels of those that the summary of a report shows.
    """
    for name, unit, meaning in rows:
        DESCRIPTIONS[name] = Description(unit, meaning, group, labels.get(name, ""))


_add(
    "Mission",
    ("duration", "s", "Time from the start of the mission to its end."),
    ("start_delay", "s", "Time from the start of the mission until the robot followed its first "
     "command."),
    ("distance_flown", "m", "Length of the path that the robot's base flew."),
    ("waypoints_reached", "1", "Number of waypoints at which the true position stayed within the "
     "tolerance, plus 3 times the position noise, for the dwell time on the operator's clock, and "
     "likewise the true yaw if the waypoint has a yaw_deg. The last row of a file of setpoints "
     "counts as one."),
    ("yaw_error", "rad", "Largest difference between the yaw_deg of a waypoint and the true yaw "
     "when the waypoint was reached."),
    ("final_error", "m", "Distance from the last setpoint of a file to the true position when the "
     "mission ended."),
    ("obstacle_contacts", "1", "Number of contacts with obstacles. These are all bodies but the "
     "floor and the body that the mission has to touch."),
    ("contact_time", "s", "Time from the start of the mission to the first touch of what it has to "
     "touch."),
    ("touch_speed", "m/s", "Speed of the probe (without one: of the base) just before this touch."),
    ("peak_contact_force", "N", "Largest force on the probe in any physics step."),
    ("contact_impulse", "N s", "Force on the probe times time, over the first 0.1 s of the first "
     "touch."),
    ("steady_contact_force", "N", "Mean force on the probe over the last 2 s of the mission."),
    *((f"steady_error_{axis}", "m", f"Mean distance from the setpoint along {axis} over the last "
       "5 s of a hover.") for axis in "xyz"),
    ("rotor_energy", "J", "Mechanical energy of the rotors in the flight, from their thrusts and "
     "speeds."),
    ("cross_track_rms", "m", "RMS distance from the true path of the base to the straight lines "
     "from its start through the waypoints, until the first touch."),
    duration="mission took",
    waypoints_reached="waypoints reached",
    final_error="from the last setpoint, at the end",
    contact_time="first touch at",
    touch_speed="speed at the first touch",
    steady_contact_force="steady contact force",
)  # fmt: skip
_add(
    "Distance to obstacles",
    ("min_clearance", "m", "Smallest distance between the robot and an obstacle while the base is "
     "inside a tube."),
    ("min_clearance_flight", "m", "Smallest distance between the robot and an obstacle during the "
     "whole flight."),
    min_clearance="least clearance",
)  # fmt: skip
_add(
    "Link and loop",
    ("rtt_mean", "s", "Mean round trip from command to echo, without the hold time in world."),
    ("rtt_p95", "s", "Round trip from command to echo, without the hold time in world: 95th "
     "percentile."),
    ("loop_delay_mean", "s", "Mean round trip from command to echo, with the hold time in world; "
     "each command counts once."),
    ("delay_sample_mean", "s", "Mean of the estimator's delay samples, one per telemetry that "
     "cloud used: the paper's tau_n, which eq. (1) averages."),
    ("age_of_information_mean", "s", "Mean age of cloud's newest odometry when it computes a "
     "command."),
    ("age_at_actuator_mean", "s", "Mean age of information at the actuator: of the odometry behind "
     "the command that the robot follows."),
    ("age_at_actuator_p99", "s", "Age of information at the actuator: in 99 % of the time, it is "
     "lower."),
    ("age_at_actuator_max", "s", "Largest age of information at the actuator."),
    ("peak_age_mean", "s", "Mean peak age: age of information at the actuator just before each "
     "command that lowers it."),
    ("age_violation", "1", "Share of the time with a command in use whose age of information is "
     "above criteria.age_deadline_s."),
    ("misses_in_10", "1", "Of any 10 successive command periods, the most that began in HOLD or "
     "with an age of information above criteria.age_deadline_s."),
    ("commands_applied", "1", "Number of commands that reached the low-level controller."),
    ("commands_withheld", "1", "Number of commands that cloud did not send, because their plan was "
     "no news (cloud.send_delta_mps) or the controller returned None."),
    rtt_mean="round trip, mean",
)  # fmt: skip
_add(
    "Estimation and tracking",
    ("prediction_error_rms", "m", "RMS distance from the predicted to the true position when each "
     "command was applied, or while the robot followed its plan."),
    ("estimate_error_rms", "m", "RMS distance from the predicted to the true position at the "
     "instant of the prediction."),
    ("delay_estimate_error_rms", "s", "RMS difference between the horizon and the true delay from "
     "odometry to applied command, from the first echo on; without plans only."),
    ("tracking_error_p95", "m", "Distance from setpoint to true position: 95th percentile."),
    ("tracking_error_peak", "m", "Largest distance from the setpoint to the true position."),
    ("control_cost", "m^2 s", "Cost of control J: integral over the mission of the squared "
     "distance from the setpoint to the true position."),
    prediction_error_rms="prediction error, RMS",
)  # fmt: skip
_add(
    "Real time",
    ("world_lateness_p99", "s", "Lateness of world's wakes: 99th percentile; real time only."),
    ("cloud_lateness_p99", "s", "Lateness of cloud's wakes: 99th percentile; real time only."),
    ("world_slip", "s", "Time by which world's clock fell behind the machine's clock because the "
     "simulation was late."),
    ("real_time_factor", "1", "Simulated time divided by time on the machine's clock; real time "
     "only."),
    ("missed_periods", "1", "Number of periods without a command because cloud was late; real time "
     "only."),
    ("controller_gaps", "1", "Number of times that the program of cloud.controller remote was "
     "silent for 0.2 s, so that the robot stood still."),
    real_time_factor="real-time factor",
)  # fmt: skip
_add(
    "Guard and faults",
    ("hold_count", "1", "Number of times that the guard went to HOLD because fresh commands were "
     "missing."),
    ("hold_time", "s", "Total time in HOLD, in which the guard flies without commands."),
    ("fault_count", "1", "Number of faults that did not stop the flight: each failed call of a "
     "plug-in in the flight, and each other fault once."),
    ("recorder_dropped", "1", "Number of records that the recorder dropped, since it started, "
     "because the loop must not wait for a disk."),
    hold_count="times in HOLD",
)  # fmt: skip
_add(
    "Steps",
    ("overshoot_mean", "1", "Mean overshoot of the steps, as a share of the step."),
    ("overshoot_max", "1", "Largest overshoot of a step, as a share of the step."),
    ("rise_time_mean", "s", "Mean time from 10 % to 90 % of a step."),
    ("settling_time_mean", "s", "Mean time until the error stays within 5 % of the step, over the "
     "steps that settled; unsettled_steps counts the others."),
    ("unsettled_steps", "1", "Number of steps, flown to their end, whose error does not stay "
     "within 5 % of the step."),
    ("iae_mean", "m s", "Integral of the error over time, mean of the steps."),
    ("ise_mean", "m^2 s", "Integral of the squared error over time, mean of the steps."),
    ("squared_command_integral_mean", "m^2/s", "Integral of the squared commanded velocity over "
     "time, mean of the steps."),
    ("unstable_steps", "1", "Number of steps in which the error oscillates without decay."),
)  # fmt: skip
_add(
    "Link and loop",
    *((f"budget_{_stage}", "s", f"Mean of a stage of the age: {_words}. Of the commands that the "
       "robot followed.") for _stage, _words in AGE_STAGES.items()),
)  # fmt: skip
_add(
    "Perception",
    ("seen_to_acted", "s", "Mean time from a scan or picture until the robot acts on it: uplink, "
     "perception, command and downlink."),
    ("seen_to_acted_p99", "s", "99th percentile of the time from a scan or picture until the robot "
     "acts on it."),
    ("seen_to_acted_max", "s", "Longest time from a scan or picture until the robot acts on it."),
    ("seen_dropped", "1", "Number of scans or pictures in whose place the perception took newer "
     "ones."),
    ("frame_age_mean", "s", "Age of the newest picture that cloud has, mean over time."),
    ("frame_age_p99", "s", "Age of the newest picture that cloud has, 99th percentile over time."),
    ("frame_age_max", "s", "Age of the newest picture that cloud has, largest."),
    ("frames_shown", "1", "Share of the pictures sent that cloud could show."),
    ("frame_psnr", "dB", "Peak signal-to-noise ratio of the pictures shown, as the codec leaves "
     "them, mean."),
    ("video_kbit", "kbit/s", "Mean bit rate of the encoded pictures, without headers."),
    ("frames_late", "1", "Number of pictures that world did not take, because the one before was "
     "still being rendered. In real time only."),
    ("out_of_view", "1", "Share of the flight in which the target of mission.follow was in truth "
     "outside of the camera's picture, or farther than distance_max_m."),
    ("bearing_error_rms", "rad", "Root mean square of the angle to the side between the axis of "
     "the camera and the target, true positions."),
    *((f"budget_{_stage}", "s", f"Mean of a stage of seen_to_acted: {_words}.")
      for _stage, _words in SCAN_STAGES.items()),
    seen_to_acted="seen to acted, mean",
    out_of_view="share out of view",
)  # fmt: skip
for _way, _words in WAYS.items():
    _add(
        "Link and loop",
        (f"{_way}_delay_mean", "s", f"Mean one-way delay {_words} of all datagrams that arrived, "
         "late ones included."),
        (f"packets_sent_{_way}", "1", f"Number of datagrams sent {_words} in the flight."),
        (f"bytes_sent_{_way}", "B", f"UDP payload of the datagrams sent {_words} in the flight."),
        (f"late_{_way}", "1", f"Share of the arrived datagrams {_words} that were too late to be "
         "used."),
        (f"loss_{_way}", "1", f"Share of the datagrams {_words} that never arrived."),
        *((f"release_error_{name}_{_way}", "s", f"Delay with which the relay released datagrams "
           f"{_words} after they were due: {which}, since the link came up.")
          for name, which in RELEASE_ERRORS.items()),
        *((f"{name}_{_way}", "1", f"Datagrams {_words} {which}")
          for name, which in RELAY_COUNTS.items()),
    )  # fmt: skip
for _each in QUANTITIES:
    if _each.name:
        _row = _each.name, _each.unit, _each.meaning
        _add(_each.group, _row, **{_each.name: _each.label})
