# SPDX-License-Identifier: Apache-2.0

"""Define all Prometheus metrics: name, type, meaning, labels, and the processes that expose them.

Names follow the rules of Prometheus: prefix `cloudrc_`, base units, `_total` at the end of
counters. Each label has a fixed set of values, or few: a robot has at most 16 sensors, and touches
few bodies. So one pod has fewer than 200 series.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping
from enum import Enum
from typing import NamedTuple

from cloudrc.messages import Cause, GuardState
from cloudrc.metrics.definitions import QUANTITIES
from cloudrc.records import FAILURES, Control

WORLD, CLOUD, TELEOP, LINK, CELL = "world", "cloud", "teleop", "link", "cell"
ROLES = (WORLD, CLOUD, TELEOP, LINK, CELL)
ENDS = (WORLD, CLOUD)

AXES = ("x", "y", "z")
TERMS = ("proportional", "integral", "derivative")
DIRECTIONS = ("uplink", "downlink")
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
MISSION_STATES = ("idle", "starting", "flying", "held", "done", "failed", "cancelled")
"""States of a mission; the value of `cloudrc_mission_state` is the index of the state."""
MISSION_OUTCOMES = ("done", "cancelled", *FAILURES, "other")
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


class LiveMetric(NamedTuple):
    """One Prometheus metric."""

    name: str  # a histogram adds `_bucket`, `_sum` and `_count`
    kind: MetricKind
    meaning: str  # the HELP text, one or two sentences
    roles: tuple[str, ...]  # processes that expose the metric
    labels: Mapping[str, Labels]  # label -> all possible values; () if they are not known
    buckets: tuple[float, ...]  # upper bounds of a histogram's buckets, rising [unit of the metric]
    counted: str  # `Counted.name` of the value, "" if none; "*" stands for the label's value


def numbered(names: tuple[str, ...]) -> str:
    """Describe states with their numbers: "0 idle, 1 starting"."""
    return ", ".join(f"{number} {name}" for number, name in enumerate(names))


_TABLE = f"""
world cloud teleop link cell
cloudrc_build_info[version, role, config]: Always 1; the labels name the process, its version and
    its configuration. Both ends of a run have the same configuration.
cloudrc_ready: 1 while this process is ready, as /readyz on the same port says, else 0.
cloudrc_cpu_periods_total: Scheduler periods (CFS) in which this container wanted CPU time.
cloudrc_cpu_throttled_periods_total: Scheduler periods cut short by the CPU limit.
cloudrc_cpu_throttled_seconds_total: Time for which the CPU limit stopped this container.

world cloud
cloudrc_session_epoch: Epoch number of the current session.
cloudrc_sessions_opened_total: Sessions opened since this process started.
cloudrc_datagrams_total[direction, outcome]: Datagrams by outcome; updated once a second.
cloudrc_sent_bytes_total = sent_bytes: UDP payload of the datagrams that this process has sent.
cloudrc_datagrams_expected_total[direction]: Datagrams that have arrived or count as lost.
cloudrc_datagrams_lost_total[direction]: Datagrams that had not arrived when the peer had sent 128
    newer ones.
cloudrc_datagrams_reordered_total[direction]: Datagrams that arrived after a newer one.
cloudrc_link_gap_seconds: Time between two arrivals: of telemetry at cloud, of commands at world.
cloudrc_link_believed[direction]: 1 if the incoming direction of the link matches its profile, 0 if
    it does not (/link.json on the same port says why); absent while datagrams are too few.
cloudrc_age_of_information_seconds: In cloud the age of the newest odometry, in world that of the
    newest command, sampled every period; absent unless both ends prove that they share a clock.
cloudrc_loop_period_seconds: Time between two periods of the loop.
cloudrc_loop_lateness_seconds: Time from the deadline of a period to the wake of the loop.
cloudrc_loop_busy_seconds_total: Time for which the loop computed.
cloudrc_recorder_dropped_records_total = recorder_dropped: Records that did not reach the recording.
cloudrc_recorder_sync_age_seconds: Time since the last complete sync of the recording to disk began:
    what a power cut would lose; absent without a recording.
cloudrc_clock_steps_total: Steps of the machine's wall clock; no flight depends on this clock.

world
cloudrc_clouds_admitted_total: Cloud processes that got a session, restarted ones included.
cloudrc_sessions_refused_total = busy: Sessions refused because another cloud controls the robot.
cloudrc_downlink_delay_seconds: One-way delay from cloud to world, late datagrams included; absent
    unless both ends prove that they share a clock.
cloudrc_sensor_value[sensor, unit]: What one of the robot's own sensors shows, in its unit.
cloudrc_command_age_seconds: Age of the current command in TRACK, sampled every period: time since
    the odometry from which cloud computed the command, on world's clock.
cloudrc_guard_state: State of the guard: {numbered(GUARD_STATES)}.
cloudrc_guard_transitions_total[state]: Changes of the guard's state, by new state; those to HOLD
    include the HOLD after each mission.
cloudrc_guard_causes_total[cause]: Changes of the guard's state, by cause.
cloudrc_guard_holds_total: HOLDs that interrupted a mission (`hold_count` in the report).
cloudrc_guard_limited_total[limit] = limited_*: Commands that a limit changed; for
    the fence, physics steps in which it changed the velocity.
cloudrc_guard_held_seconds_total: Time in these HOLDs (`hold_time` in the report).
cloudrc_guard_starts_refused_total = start_refused: Mission starts refused in LAND or ESTOP.
cloudrc_contacts_total[body]: Contacts of the robot with bodies of the scene, by body; absent
    before the first one.
cloudrc_real_time_factor: Simulated time divided by machine time over the last 10 s; below 0.95 a
    run is invalid.
cloudrc_world_slip_seconds_total: Time by which world's clock has fallen behind the machine's clock.
cloudrc_world_stalls_total = stalls: Times that world woke so late that the waiting datagrams
    were stale.

cloud
cloudrc_uplink_delay_seconds: One-way delay from world to cloud, late datagrams included; absent
    unless both ends prove that they share a clock.
cloudrc_rtt_seconds: Round trip of applied commands, without their time in world.
cloudrc_loop_delay_seconds: Round trip of applied commands, with their time in world; each command
    counts once.
cloudrc_delay_sample_seconds: Delay samples of the estimator, one per telemetry that cloud used: the
    paper's tau_n, which eq. (1) averages.
cloudrc_delay_estimate_error_seconds: Delay estimate minus the true time from the odometry to the
    application of the command, for the newest command that the robot confirmed; absent with plans.
cloudrc_estimate_error_meters[axis]: Predicted minus measured position at the instant of the
    prediction, newest value.
cloudrc_estimate_error_square_meters_total: Sum of the squared lengths of all estimate errors
    since the process started.
cloudrc_predictions_judged_total: Predictions compared with a measurement.
cloudrc_pid_output[term, axis]: Terms of the controller's output [m/s], in the newest period.
cloudrc_horizon_clamped_total = horizon_clamped: Delay estimates clamped to the range 0 to
    cloud.horizon_max_s.
cloudrc_commands_frozen_total = frozen: Commands of zero velocity, because the robot confirmed no
    newer command.
cloudrc_commands_withheld_total = commands_withheld: Commands that cloud did not send, because their
    plan was no news (cloud.send_delta_mps) or the controller returned None.
cloudrc_plugin_failures_total[plugin] = *_failed: Plug-in calls that raised, or returned a wrong
    value.
cloudrc_controller_gaps_total = controller_gaps: Times that the program of cloud.controller remote
    was silent for 0.2 s, so that the robot stood still.
cloudrc_words_dropped_total = words_dropped: Messages of teleop that cloud dropped, because
    they were for another session or no request number was left.
cloudrc_loop_missed_periods_total = missed_periods: Periods without a command because the loop was
    late.

teleop
cloudrc_mission_state: State of the mission: {numbered(MISSION_STATES)}.
cloudrc_mission_waypoint: Index of the next waypoint; -1 if none.
cloudrc_waypoints_reached_total: Waypoints reached, as teleop sees it; `waypoints_reached` in the
    report also checks the true position.
cloudrc_missions_total[outcome]: Missions ended, by outcome.
cloudrc_missions_failed_total = missions_failed: Missions whose verdict is a failure: one that is
    done may have failed its criteria. The report, which knows the true path, may judge otherwise.
cloudrc_api_requests_total = api_served: Requests that the API has served.
cloudrc_api_rejected_total[reason] = api_*: Requests that the API rejected, by reason.
cloudrc_missions_refused_total[reason] = api_order_*: Mission orders that the API refused, by
    reason.
cloudrc_stream_dropped_events_total = api_events_dropped: Events that slow readers of the event
    stream missed.
cloudrc_journal_repaired_total = journal_repaired: Times that teleop set a damaged journal aside and
    began a new one.

link
cloudrc_link_info[shaper, direction, mode]: Always 1; the labels name the shaper of a direction of
    the link, and the configured mode.
cloudrc_link_delay_seconds[direction]: Mean one-way delay that the current link profile sets.
cloudrc_link_step_lateness_seconds[percentile] = step_lateness_p*_ns: Lateness of netem's last
    10,000 changes on the profile's time line; absent without changes.
cloudrc_link_datagrams_total[outcome] = *: Datagrams at the shaper, by outcome.
cloudrc_link_restored_total = restored: Times that another program removed or changed netem's
    settings.
cloudrc_link_release_error_seconds[percentile] = release_error_p*_ns: Lateness of datagrams that
    left the relay in the last 10 s; absent with netem.
cloudrc_link_released_early_total = released_early: Datagrams that left the relay too early; above 0
    the relay has a bug; absent with netem.
cloudrc_dns_errors_total = unresolved: Failed look-ups of the peer's name; the last known address
    stays in use.

cell
cloudrc_cell_utilisation[direction]: Part of the last tenth of a second in which the cell was busy.
cloudrc_cell_queue_packets[direction]: Largest number of packets that waited in the last tenth of a
    second.
cloudrc_cell_dropped_total[robot, direction]: Packets of a robot that the full queue dropped, or
    that a newer packet replaced.
cloudrc_cell_wait_seconds[direction]: Mean wait of the packets that left in the last tenth of a
    second; absent without packets.
"""
"""All metrics but those of `QUANTITIES`, in blocks: the processes that expose them, then
name[labels] = count: meaning."""
_OF_CELL = "utilisation", "queue_packets", "dropped_total", "wait_seconds"
_LABELS: Mapping[str, Labels] = {
    **dict.fromkeys(("version", "config", "sensor", "unit", "body", "robot"), ()),
    "role": ROLES,
    "direction": DIRECTIONS,
    "axis": AXES,
    "term": TERMS,
    "plugin": ("estimator", "predictor", "controller"),
    "state": GUARD_STATES,
    "cause": tuple(dict.fromkeys(GUARD_CAUSES.values())),
    "limit": LIMITS,
    "shaper": ("relay", "netem"),
    "mode": ("auto", "relay", "netem"),
    "cloudrc_datagrams_total outcome": OUTCOMES,
    "cloudrc_missions_total outcome": MISSION_OUTCOMES,
    # "token": no valid token; "role": a reader's token; "busy": too many requests at a time.
    "cloudrc_api_rejected_total reason": ("token", "role", "busy"),
    # "conflict": another mission is in the way.
    "cloudrc_missions_refused_total reason": ("invalid", "conflict"),
    "cloudrc_link_step_lateness_seconds percentile": ("50", "99"),
    "cloudrc_link_release_error_seconds percentile": RELEASE_PERCENTILES,
    "cloudrc_link_datagrams_total outcome": LINK_OUTCOMES,
    **{f"cloudrc_cell_{name} direction": (*DIRECTIONS, "both") for name in _OF_CELL},
}
"""Label, or metric and label -> all values of the label; () if the values are not known."""
_DELAYS = "uplink_delay downlink_delay age_of_information rtt command_age"
_BUCKETS: Mapping[str, tuple[float, ...]] = {
    # Jitter causes gaps below 50 ms; after 250 ms the guard holds. Of the two delays the mean is
    # of interest: cloudrc_rtt_seconds has finer buckets.
    **{
        f"cloudrc_{name}_seconds": (0.05, 0.25)
        for name in ("link_gap", "loop_delay", "delay_sample")
    },
    **{
        f"cloudrc_{name}_seconds": (0.005, 0.01, 0.02, 0.05, 0.1, 0.15, 0.25, 1.0)
        for name in _DELAYS.split()
    },
    # The nominal period is 10 ms.
    "cloudrc_loop_period_seconds": (0.009, 0.0095, 0.0105, 0.011, 0.015, 0.02, 0.05, 0.1),
    "cloudrc_loop_lateness_seconds": (0.0001, 0.0005, 0.001, 0.002, 0.005, 0.01, 0.05),
}
"""Name of a histogram -> upper bounds of its buckets [s]."""


_ENTRY = re.compile(r"^(cloudrc_\w+)(?:\[(.*)\])?(?: = (\S+))?: (.*(?:\n .*)*)", re.MULTILINE)


def _metrics() -> Iterator[LiveMetric]:
    for section in _TABLE.strip().split("\n\n"):
        roles, _, text = section.partition("\n")
        for name, names, count, meaning in _ENTRY.findall(text):
            labels = {
                each: _LABELS.get(f"{name} {each}") or _LABELS[each]
                for each in re.findall(r"\w+", names)
            }
            buckets = _BUCKETS.get(name, ())
            kind = MetricKind.COUNTER if name.endswith("_total") else MetricKind.GAUGE
            kind = MetricKind.HISTOGRAM if buckets else kind
            one_line = " ".join(meaning.split())
            yield LiveMetric(name, kind, one_line, tuple(roles.split()), labels, buckets, count)
        for quantity in QUANTITIES:
            role = CLOUD if quantity.source is Control else WORLD
            if quantity.live and role == roles:
                name, is_vector, _ = quantity.live.partition("[axis]")
                labels = {"axis": AXES} if is_vector else {}
                yield LiveMetric(name, MetricKind.GAUGE, quantity.now, (role,), labels, (), "")


METRICS = {metric.name: metric for metric in _metrics()}
"""All metrics by name, in the order of the blocks of `_TABLE`."""


def of_role(role: str) -> list[LiveMetric]:
    """List the metrics that processes with this role, one of `ROLES`, expose."""
    return [metric for metric in METRICS.values() if role in metric.roles]
