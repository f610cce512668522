# SPDX-License-Identifier: Apache-2.0

"""Define all Prometheus metrics: name, type, meaning, labels, and the processes that expose them.

Names follow the rules of Prometheus: prefix `cloudrc_`, base units, `_total` at the end of
counters. Each label has a fixed set of values, or few: a robot has at most 16 sensors, and touches
few bodies. So one pod has fewer than 200 series.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from enum import Enum
from typing import NamedTuple, get_args

from cloudrc.results.metrics.definitions import QUANTITIES
from cloudrc.wire.messages import Cause, GuardState
from cloudrc.wire.records import Control, MissionEnd, MissionState

WORLD, CLOUD, TELEOP, LINK, CELL = "world", "cloud", "teleop", "link", "cell"
ROLES = (WORLD, CLOUD, TELEOP, LINK, CELL)
ENDS = (WORLD, CLOUD)

AXES = ("x", "y", "z")
TERMS = ("proportional", "integral", "derivative")
DIRECTIONS = ("uplink", "downlink")
CELL_DIRECTIONS = (*DIRECTIONS, "both")
"""Directions of a cell; one that both share has "both"."""
OUTCOMES = (
    "sent",
    "used",
    "late",
    "stale",
    "repeated",
    "old_epoch",
    "range",
    "vertical",
    "future",
    "malformed",
    "version",
    "direction",
    "accept_ignored",
    "tag",
    "hello",
    "busy",
    "unanswered",
)
"""Outcomes of a datagram. The sender counts "sent", the receiver counts all other outcomes."""
ONLY_WORLD = {"stale", "range", "vertical", "future", "hello", "unanswered"}
"""Outcomes that only world counts."""
ONLY_CLOUD = {"accept_ignored"}
"""Outcomes that only cloud counts."""
LIMITS = ("speed", "yaw_rate", "fence")
"""Limits to which the guard restricts commands."""
GUARD_STATES = tuple(state.name.lower() for state in GuardState)
GUARD_CAUSES = {cause: cause.words.partition(",")[0] for cause in Cause}
"""Cause of a guard's state -> value of the label `cause`, the first words of the cause."""
MISSION_STATES = ("idle", *(state for state in get_args(MissionState) if state != "queued"))
"""States of a mission; the value of `cloudrc_mission_state` is the index of the state."""
MISSION_OUTCOMES = (*get_args(MissionEnd), "other")
LINK_OUTCOMES = ("received", "forwarded", "lost", "malformed", "overflow", "unread", "unsent")
"""Outcomes of a datagram at the relay; `cloudrc.link.carry.udp.Relay.counts` explains them."""
RELEASE_PERCENTILES = ("50", "99", "99.9")
"""Percentiles of the relay's release error; the count for "99.9" is `release_error_p999_ns`."""

Labels = tuple[str, ...]


class MetricKind(Enum):
    """Type of a metric, as Prometheus names it."""

    COUNTER = "counter"
    GAUGE = "gauge"
    HISTOGRAM = "histogram"


COUNTER, GAUGE, HISTOGRAM = MetricKind
NO_LABELS: Mapping[str, Labels] = {}


class LiveMetric(NamedTuple):
    """One Prometheus metric."""

    roles: tuple[str, ...]  # processes that expose the metric
    kind: MetricKind
    name: str  # a histogram adds `_bucket`, `_sum` and `_count`
    meaning: str  # the HELP text, one or two sentences
    labels: Mapping[str, Labels] = NO_LABELS  # label -> all values; () if they are not known
    buckets: tuple[float, ...] = ()  # upper bounds of a histogram's buckets, rising [metric's unit]
    counted: str = ""  # `Counted.name` of the value, "" if none; "*" stands for the label's value


def numbered(names: tuple[str, ...]) -> str:
    """Describe states with their numbers: "0 idle, 1 starting"."""
    return ", ".join(f"{number} {name}" for number, name in enumerate(names))


def _of_quantities(role: str) -> Iterator[LiveMetric]:
    """Yield the metrics of the quantities whose records a process with this role makes."""
    for quantity in QUANTITIES:
        if quantity.live and role == (CLOUD if quantity.source is Control else WORLD):
            name, is_vector, _ = quantity.live.partition("[axis]")
            labels = {"axis": AXES} if is_vector else NO_LABELS
            yield LiveMetric((role,), GAUGE, name, quantity.now, labels)


GAP_BUCKETS = (0.05, 0.25)
"""Bounds for gaps [s]: jitter causes gaps below 50 ms, and after 250 ms the guard holds. Also for
two delays of which the mean is of interest: cloudrc_rtt_seconds has finer buckets."""
DELAY_BUCKETS = (0.005, 0.01, 0.02, 0.05, 0.1, 0.15, 0.25, 1.0)
"""Bounds for delays and ages [s]."""
FRAME_BUCKETS = (0.005, 0.01, 0.02, 0.05, 0.1, 0.2)
"""Bounds for the time that a picture takes [s]: 10 pictures a second allow 0.1 s each."""
# fmt: off
_TABLE = (
    LiveMetric(ROLES, GAUGE, "cloudrc_build_info",
               "Always 1; the labels name the process, its version and its configuration. Both "
               "ends of a run have the same configuration.",
               {"version": (), "role": ROLES, "config": ()}),
    LiveMetric(ROLES, GAUGE, "cloudrc_ready",
               "1 while this process is ready, as /readyz on the same port says, else 0."),
    LiveMetric(ROLES, COUNTER, "cloudrc_cpu_periods_total",
               "Scheduler periods (CFS) in which this container wanted CPU time."),
    LiveMetric(ROLES, COUNTER, "cloudrc_cpu_throttled_periods_total",
               "Scheduler periods cut short by the CPU limit."),
    LiveMetric(ROLES, COUNTER, "cloudrc_cpu_throttled_seconds_total",
               "Time for which the CPU limit stopped this container."),
    LiveMetric(ENDS, GAUGE, "cloudrc_session_epoch", "Epoch number of the current session."),
    LiveMetric(ENDS, COUNTER, "cloudrc_sessions_opened_total",
               "Sessions opened since this process started."),
    LiveMetric(ENDS, COUNTER, "cloudrc_datagrams_total",
               "Datagrams by outcome; updated once a second.",
               {"direction": DIRECTIONS, "outcome": OUTCOMES}),
    LiveMetric(ENDS, COUNTER, "cloudrc_sent_bytes_total",
               "UDP payload of the datagrams that this process has sent.", counted="sent_bytes"),
    LiveMetric(ENDS, COUNTER, "cloudrc_datagrams_expected_total",
               "Datagrams that have arrived or count as lost.", {"direction": DIRECTIONS}),
    LiveMetric(ENDS, COUNTER, "cloudrc_datagrams_lost_total",
               "Datagrams that had not arrived when the peer had sent 128 newer ones.",
               {"direction": DIRECTIONS}),
    LiveMetric(ENDS, COUNTER, "cloudrc_datagrams_reordered_total",
               "Datagrams that arrived after a newer one.", {"direction": DIRECTIONS}),
    LiveMetric(ENDS, HISTOGRAM, "cloudrc_link_gap_seconds",
               "Time between two arrivals: of telemetry at cloud, of commands at world.",
               buckets=GAP_BUCKETS),
    LiveMetric(ENDS, GAUGE, "cloudrc_link_believed",
               "1 if the incoming direction of the link matches its profile, 0 if it does not "
               "(/link.json on the same port says why); absent while datagrams are too few.",
               {"direction": DIRECTIONS}),
    LiveMetric(ENDS, HISTOGRAM, "cloudrc_age_of_information_seconds",
               "In cloud the age of the newest odometry, in world that of the newest command, "
               "sampled every period; absent unless both ends prove that they share a clock.",
               buckets=DELAY_BUCKETS),
    # The nominal period is 10 ms.
    LiveMetric(ENDS, HISTOGRAM, "cloudrc_loop_period_seconds",
               "Time between two periods of the loop.",
               buckets=(0.009, 0.0095, 0.0105, 0.011, 0.015, 0.02, 0.05, 0.1)),
    LiveMetric(ENDS, HISTOGRAM, "cloudrc_loop_lateness_seconds",
               "Time from the deadline of a period to the wake of the loop.",
               buckets=(0.0001, 0.0005, 0.001, 0.002, 0.005, 0.01, 0.05)),
    LiveMetric(ENDS, COUNTER, "cloudrc_loop_busy_seconds_total",
               "Time for which the loop computed."),
    LiveMetric(ENDS, COUNTER, "cloudrc_recorder_dropped_records_total",
               "Records that did not reach the recording.", counted="recorder_dropped"),
    LiveMetric(ENDS, GAUGE, "cloudrc_recorder_sync_age_seconds",
               "Time since the last complete sync of the recording to disk began: what a power "
               "cut would lose; absent without a recording."),
    LiveMetric(ENDS, COUNTER, "cloudrc_clock_steps_total",
               "Steps of the machine's wall clock; no flight depends on this clock."),
    LiveMetric((WORLD,), COUNTER, "cloudrc_clouds_admitted_total",
               "Cloud processes that got a session, restarted ones included."),
    LiveMetric((WORLD,), COUNTER, "cloudrc_sessions_refused_total",
               "Sessions refused because another cloud controls the robot.", counted="busy"),
    LiveMetric((WORLD,), HISTOGRAM, "cloudrc_downlink_delay_seconds",
               "One-way delay from cloud to world, late datagrams included; absent unless both "
               "ends prove that they share a clock.", buckets=DELAY_BUCKETS),
    LiveMetric((WORLD,), GAUGE, "cloudrc_sensor_value",
               "What one of the robot's own sensors shows, in its unit.",
               {"sensor": (), "unit": ()}),
    LiveMetric((WORLD,), HISTOGRAM, "cloudrc_command_age_seconds",
               "Age of the current command in TRACK, sampled every period: time since the "
               "odometry from which cloud computed the command, on world's clock.",
               buckets=DELAY_BUCKETS),
    LiveMetric((WORLD,), GAUGE, "cloudrc_guard_state",
               f"State of the guard: {numbered(GUARD_STATES)}."),
    LiveMetric((WORLD,), COUNTER, "cloudrc_guard_transitions_total",
               "Changes of the guard's state, by new state; those to HOLD include the HOLD after "
               "each mission.", {"state": GUARD_STATES}),
    LiveMetric((WORLD,), COUNTER, "cloudrc_guard_causes_total",
               "Changes of the guard's state, by cause.",
               {"cause": tuple(dict.fromkeys(GUARD_CAUSES.values()))}),
    LiveMetric((WORLD,), COUNTER, "cloudrc_guard_holds_total",
               "HOLDs that interrupted a mission (`hold_count` in the report)."),
    LiveMetric((WORLD,), COUNTER, "cloudrc_guard_limited_total",
               "Commands that a limit changed; for the fence, physics steps in which it changed "
               "the velocity.", {"limit": LIMITS}, counted="limited_*"),
    LiveMetric((WORLD,), COUNTER, "cloudrc_guard_held_seconds_total",
               "Time in these HOLDs (`hold_time` in the report)."),
    LiveMetric((WORLD,), COUNTER, "cloudrc_guard_starts_refused_total",
               "Mission starts refused in LAND or ESTOP.", counted="start_refused"),
    LiveMetric((WORLD,), COUNTER, "cloudrc_contacts_total",
               "Contacts of the robot with bodies of the scene, by body; absent before the first "
               "one.", {"body": ()}),
    LiveMetric((WORLD,), GAUGE, "cloudrc_real_time_factor",
               "Simulated time divided by machine time over the last 10 s; below 0.95 a run is "
               "invalid."),
    LiveMetric((WORLD,), COUNTER, "cloudrc_world_slip_seconds_total",
               "Time by which world's clock has fallen behind the machine's clock."),
    LiveMetric((WORLD,), COUNTER, "cloudrc_world_stalls_total",
               "Times that world woke so late that the waiting datagrams were stale.",
               counted="stalls"),
    LiveMetric((WORLD,), COUNTER, "cloudrc_camera_late_total",
               "Pictures that were not taken, because the one before was still being rendered.",
               counted="frames_late"),
    LiveMetric((WORLD,), HISTOGRAM, "cloudrc_camera_seconds",
               "Time that rendering and encoding a picture took; absent without a camera.",
               buckets=FRAME_BUCKETS),
    *_of_quantities(WORLD),
    LiveMetric((CLOUD,), HISTOGRAM, "cloudrc_uplink_delay_seconds",
               "One-way delay from world to cloud, late datagrams included; absent unless both "
               "ends prove that they share a clock.", buckets=DELAY_BUCKETS),
    LiveMetric((CLOUD,), HISTOGRAM, "cloudrc_rtt_seconds",
               "Round trip of applied commands, without their time in world.",
               buckets=DELAY_BUCKETS),
    LiveMetric((CLOUD,), HISTOGRAM, "cloudrc_loop_delay_seconds",
               "Round trip of applied commands, with their time in world; each command counts "
               "once.", buckets=GAP_BUCKETS),
    LiveMetric((CLOUD,), HISTOGRAM, "cloudrc_delay_sample_seconds",
               "Delay samples of the estimator, one per telemetry that cloud used: the paper's "
               "tau_n, which eq. (1) averages.", buckets=GAP_BUCKETS),
    LiveMetric((CLOUD,), GAUGE, "cloudrc_delay_estimate_error_seconds",
               "Delay estimate minus the true time from the odometry to the application of the "
               "command, for the newest command that the robot confirmed; absent with plans."),
    LiveMetric((CLOUD,), GAUGE, "cloudrc_estimate_error_meters",
               "Predicted minus measured position at the instant of the prediction, newest value.",
               {"axis": AXES}),
    LiveMetric((CLOUD,), COUNTER, "cloudrc_estimate_error_square_meters_total",
               "Sum of the squared lengths of all estimate errors since the process started."),
    LiveMetric((CLOUD,), COUNTER, "cloudrc_predictions_judged_total",
               "Predictions compared with a measurement."),
    LiveMetric((CLOUD,), GAUGE, "cloudrc_pid_output",
               "Terms of the controller's output [m/s], in the newest period.",
               {"term": TERMS, "axis": AXES}),
    LiveMetric((CLOUD,), COUNTER, "cloudrc_horizon_clamped_total",
               "Delay estimates clamped to the range 0 to cloud.horizon_max_s.",
               counted="horizon_clamped"),
    LiveMetric((CLOUD,), COUNTER, "cloudrc_commands_frozen_total",
               "Commands of zero velocity, because the robot confirmed no newer command.",
               counted="frozen"),
    LiveMetric((CLOUD,), COUNTER, "cloudrc_commands_withheld_total",
               "Commands that cloud did not send, because their plan was no news "
               "(cloud.send_delta_mps) or the controller returned None.",
               counted="commands_withheld"),
    LiveMetric((CLOUD,), COUNTER, "cloudrc_plugin_failures_total",
               "Plug-in calls that raised, or returned a wrong value.",
               {"plugin": ("estimator", "predictor", "controller")}, counted="*_failed"),
    LiveMetric((CLOUD,), COUNTER, "cloudrc_controller_gaps_total",
               "Times that the program of cloud.controller remote was silent for 0.2 s, so that "
               "the robot stood still.", counted="controller_gaps"),
    LiveMetric((CLOUD,), COUNTER, "cloudrc_words_dropped_total",
               "Messages of teleop that cloud dropped, because they were for another session or "
               "no request number was left.", counted="words_dropped"),
    LiveMetric((CLOUD,), COUNTER, "cloudrc_loop_missed_periods_total",
               "Periods without a command because the loop was late.", counted="missed_periods"),
    *_of_quantities(CLOUD),
    LiveMetric((TELEOP,), GAUGE, "cloudrc_mission_state",
               f"State of the mission: {numbered(MISSION_STATES)}."),
    LiveMetric((TELEOP,), GAUGE, "cloudrc_mission_waypoint",
               "Index of the next waypoint; -1 if none."),
    LiveMetric((TELEOP,), COUNTER, "cloudrc_waypoints_reached_total",
               "Waypoints reached, as teleop sees it; `waypoints_reached` in the report also "
               "checks the true position."),
    LiveMetric((TELEOP,), COUNTER, "cloudrc_missions_total",
               "Missions ended, by outcome.", {"outcome": MISSION_OUTCOMES}),
    LiveMetric((TELEOP,), COUNTER, "cloudrc_missions_failed_total",
               "Missions whose verdict is a failure: one that is done may have failed its "
               "criteria. The report, which knows the true path, may judge otherwise.",
               counted="missions_failed"),
    LiveMetric((TELEOP,), COUNTER, "cloudrc_api_requests_total",
               "Requests that the API has served.", counted="api_served"),
    # "token": no valid token; "role": a reader's token; "busy": too many requests at a time.
    LiveMetric((TELEOP,), COUNTER, "cloudrc_api_rejected_total",
               "Requests that the API rejected, by reason.",
               {"reason": ("token", "role", "busy")}, counted="api_*"),
    # "conflict": another mission is in the way.
    LiveMetric((TELEOP,), COUNTER, "cloudrc_missions_refused_total",
               "Mission orders that the API refused, by reason.",
               {"reason": ("invalid", "conflict")}, counted="api_order_*"),
    LiveMetric((TELEOP,), COUNTER, "cloudrc_stream_dropped_events_total",
               "Events that slow readers of the event stream missed.",
               counted="api_events_dropped"),
    LiveMetric((TELEOP,), COUNTER, "cloudrc_journal_repaired_total",
               "Times that teleop set a damaged journal aside and began a new one.",
               counted="journal_repaired"),
    LiveMetric((LINK,), GAUGE, "cloudrc_link_info",
               "Always 1; the labels name the shaper of a direction of the link, and the "
               "configured mode.",
               {"shaper": ("relay", "netem"), "direction": DIRECTIONS,
                "mode": ("auto", "relay", "netem")}),
    LiveMetric((LINK,), GAUGE, "cloudrc_link_delay_seconds",
               "Mean one-way delay that the current link profile sets.", {"direction": DIRECTIONS}),
    LiveMetric((LINK,), GAUGE, "cloudrc_link_step_lateness_seconds",
               "Lateness of netem's last 10,000 changes on the profile's schedule; absent "
               "without changes.", {"percentile": ("50", "99")}, counted="step_lateness_p*_ns"),
    LiveMetric((LINK,), COUNTER, "cloudrc_link_datagrams_total",
               "Datagrams at the shaper, by outcome.", {"outcome": LINK_OUTCOMES}, counted="*"),
    LiveMetric((LINK,), COUNTER, "cloudrc_link_restored_total",
               "Times that another program removed or changed netem's settings.",
               counted="restored"),
    LiveMetric((LINK,), GAUGE, "cloudrc_link_release_error_seconds",
               "Lateness of datagrams that left the relay in the last 10 s; absent with netem.",
               {"percentile": RELEASE_PERCENTILES}, counted="release_error_p*_ns"),
    LiveMetric((LINK,), COUNTER, "cloudrc_link_released_early_total",
               "Datagrams that left the relay too early; above 0 the relay has a bug; absent with "
               "netem.", counted="released_early"),
    LiveMetric((LINK,), COUNTER, "cloudrc_dns_errors_total",
               "Failed look-ups of the peer's name; the last known address stays in use.",
               counted="unresolved"),
    LiveMetric((CELL,), GAUGE, "cloudrc_cell_utilisation",
               "Part of the last tenth of a second in which the cell was busy.",
               {"direction": CELL_DIRECTIONS}),
    LiveMetric((CELL,), GAUGE, "cloudrc_cell_queue_packets",
               "Largest number of packets that waited in the last tenth of a second.",
               {"direction": CELL_DIRECTIONS}),
    LiveMetric((CELL,), COUNTER, "cloudrc_cell_dropped_total",
               "Packets of a robot that the full queue dropped, or that a newer packet replaced.",
               {"robot": (), "direction": CELL_DIRECTIONS}),
    LiveMetric((CELL,), GAUGE, "cloudrc_cell_wait_seconds",
               "Mean wait of the packets that left in the last tenth of a second; absent without "
               "packets.", {"direction": CELL_DIRECTIONS}),
)
# fmt: on
METRICS = {metric.name: metric for metric in _TABLE}
"""All metrics by name, in the order of the processes that expose them."""


def of_role(role: str) -> list[LiveMetric]:
    """List the metrics that processes with this role, one of `ROLES`, expose."""
    return [metric for metric in METRICS.values() if role in metric.roles]
