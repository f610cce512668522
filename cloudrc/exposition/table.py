"""The table of all Prometheus metrics: name, kind, meaning, closed label sets, who exposes it.

Names follow Prometheus' rules: prefix `cloudrc_`, base units, counters end in `_total`. Every
label has a closed set of values, so that one pod stays below 200 series.
"""

from __future__ import annotations

from collections.abc import Mapping
from types import MappingProxyType

from cloudrc.exposition.labels import (
    AXES,
    BODIES,
    CLOUD,
    DIRECTIONS,
    ENDS,
    GAP_BUCKETS,
    GUARD_STATES,
    LATENESS_BUCKETS,
    LIMITS,
    OUTCOMES,
    PERIOD_BUCKETS,
    PLUGINS,
    ROLES,
    TERMS,
    WORLD,
)
from cloudrc.exposition.metric import Kind, Metric, counter, delay, gauge, numbered
from cloudrc.exposition.table_check import CHECK
from cloudrc.exposition.table_link import LINKS
from cloudrc.exposition.table_mission import MISSIONS

_ENTRIES = (
    # Every process.
    Metric(
        "cloudrc_build_info",
        Kind.GAUGE,
        "1; its labels say which process of which version this is, and by which configuration it "
        "runs: two ends that differ in it were told different things.",
        ROLES,
        {"version": (), "role": ROLES, "config": ()},
    ),
    gauge("cloudrc_ready", "1 while this process hears its peer, else 0.", ROLES),
    counter(
        "cloudrc_cpu_periods_total", "CFS periods in which this container wanted to run.", ROLES
    ),
    counter(
        "cloudrc_cpu_throttled_periods_total",
        "CFS periods in which this container was stopped by its CPU limit.",
        ROLES,
    ),
    counter(
        "cloudrc_cpu_throttled_seconds_total",
        "Time for which this container was stopped by its CPU limit.",
        ROLES,
    ),
    # Both ends: session and link.
    gauge("cloudrc_session_epoch", "Number of the session under way.", ENDS),
    counter("cloudrc_sessions_opened_total", "Sessions opened since this process began.", ENDS),
    counter(
        "cloudrc_clouds_admitted_total",
        "Clouds that were given a session: the first one, a restarted one, another one.",
        (WORLD,),
    ),
    counter(
        "cloudrc_sessions_refused_total",
        "Requests for a session that were refused because another cloud has authority.",
        (WORLD,),
    ),
    counter(
        "cloudrc_datagrams_total",
        "Datagrams by what became of them; told once a second.",
        ENDS,
        direction=DIRECTIONS,
        outcome=OUTCOMES,
    ),
    counter(
        "cloudrc_datagrams_expected_total",
        "Telemetry or command datagrams judged so far: arrived, or lost on the link.",
        ENDS,
        direction=DIRECTIONS,
    ),
    counter(
        "cloudrc_datagrams_lost_total",
        "Those of the expected that had not arrived when 128 newer ones were sent.",
        ENDS,
        direction=DIRECTIONS,
    ),
    counter(
        "cloudrc_datagrams_reordered_total",
        "Telemetry or command datagrams that arrived after a newer one.",
        ENDS,
        direction=DIRECTIONS,
    ),
    Metric(
        "cloudrc_link_gap_seconds",
        Kind.HISTOGRAM,
        "Time from one telemetry (at cloud) or command (at world) to the next that arrived.",
        ENDS,
        buckets=GAP_BUCKETS,
    ),
    delay(
        "cloudrc_uplink_delay_seconds",
        "One-way delay from world to cloud, late datagrams included; absent unless both ends"
        " prove that they share a clock.",
        (CLOUD,),
    ),
    delay(
        "cloudrc_downlink_delay_seconds",
        "One-way delay from cloud to world, late datagrams included; absent unless both ends"
        " prove that they share a clock.",
        (WORLD,),
    ),
    *CHECK,
    delay(
        "cloudrc_age_of_information_seconds",
        "Now minus the stamp of the newest datagram used, in every period: of odometry in cloud,"
        " of commands in world; absent unless both ends prove that they share a clock.",
        ENDS,
    ),
    # Cloud: delays as the loop sees them.
    delay(
        "cloudrc_rtt_seconds",
        "Round trip of applied commands, the hold in world excluded; one sample per new echo.",
        (CLOUD,),
    ),
    delay(
        "cloudrc_loop_delay_seconds",
        "From a command's stamp to its echo, the hold in world included: the paper's tau.",
        (CLOUD,),
    ),
    gauge(
        "cloudrc_delay_estimate_seconds",
        "By how much the newest odometry is moved ahead: the delay estimate, clamped.",
        (CLOUD,),
    ),
    gauge(
        "cloudrc_delay_estimate_error_seconds",
        "Delay estimate minus the time that really passed from odometry to the application of"
        " the command; of the newest command echoed.",
        (CLOUD,),
    ),
    # Cloud: prediction and control.
    gauge(
        "cloudrc_prediction_error_meters",
        "Position predicted for an instant minus the one measured at that instant; the newest.",
        (CLOUD,),
        axis=AXES,
    ),
    counter(
        "cloudrc_prediction_error_square_meters_total",
        "Sum of the squared lengths of all prediction errors.",
        (CLOUD,),
    ),
    counter(
        "cloudrc_predictions_judged_total",
        "Predictions compared with a measurement.",
        (CLOUD,),
    ),
    gauge(
        "cloudrc_tracking_error_meters",
        "Setpoint minus measured position, in the newest period.",
        (CLOUD,),
        axis=AXES,
    ),
    gauge("cloudrc_setpoint_meters", "Setpoint of the position.", (CLOUD,), axis=AXES),
    gauge(
        "cloudrc_pid_output",
        "Terms of the controller's output [m/s], in the newest period.",
        (CLOUD,),
        axis=AXES,
        term=TERMS,
    ),
    gauge(
        "cloudrc_command_velocity_meters_per_second",
        "Velocity commanded, world frame.",
        (CLOUD,),
        axis=AXES,
    ),
    gauge("cloudrc_command_yaw_rate_radians_per_second", "Yaw rate commanded.", (CLOUD,)),
    counter("cloudrc_horizon_clamped_total", "Delay estimates above 1 s or below 0.", (CLOUD,)),
    counter("cloudrc_commands_frozen_total", "Commands to stand still: no echo comes.", (CLOUD,)),
    counter(
        "cloudrc_plugin_failures_total",
        "Calls of a plug-in that raised or gave something not finite.",
        (CLOUD,),
        plugin=PLUGINS,
    ),
    # World: robot and guard.
    gauge(
        "cloudrc_position_meters", "True position of the base, world frame.", (WORLD,), axis=AXES
    ),
    gauge("cloudrc_tip_force_newtons", "Force on the touch sensor at the arm's tip.", (WORLD,)),
    delay(
        "cloudrc_command_age_seconds",
        "Age of the command that is flown, in every period of TRACK: since the odometry it was"
        " computed from, by world's own clock, as the guard judges it.",
        (WORLD,),
    ),
    gauge("cloudrc_guard_state", f"State of the guard: {numbered(GUARD_STATES)}.", (WORLD,)),
    counter(
        "cloudrc_guard_transitions_total",
        "Changes of the guard into a state.",
        (WORLD,),
        state=GUARD_STATES,
    ),
    counter(
        "cloudrc_guard_limited_total",
        "Commands (ticks: fence) that a limit of the guard changed.",
        (WORLD,),
        limit=LIMITS,
    ),
    counter(
        "cloudrc_guard_held_seconds_total",
        "Time in HOLD while a mission was on; told once a second.",
        (WORLD,),
    ),
    counter(
        "cloudrc_guard_starts_refused_total",
        "Starts refused in LAND or ESTOP, or for want of an epoch.",
        (WORLD,),
    ),
    counter(
        "cloudrc_contacts_total",
        "Times that the robot began to touch a body of the scene, by its kind.",
        (WORLD,),
        body=BODIES,
    ),
    gauge(
        "cloudrc_real_time_factor",
        "Simulated by machine time over the last 10 s; below 0.95 a run is invalid.",
        (WORLD,),
    ),
    counter(
        "cloudrc_world_slip_seconds_total",
        "By how much world's clock has fallen behind its machine's.",
        (WORLD,),
    ),
    counter(
        "cloudrc_world_stalls_total",
        "Wakes after which what waited in the socket was stale.",
        (WORLD,),
    ),
    # Both ends: the process.
    Metric(
        "cloudrc_loop_period_seconds",
        Kind.HISTOGRAM,
        "Time between two deadlines handled.",
        ENDS,
        buckets=PERIOD_BUCKETS,
    ),
    Metric(
        "cloudrc_loop_lateness_seconds",
        Kind.HISTOGRAM,
        "How long after its deadline the loop woke.",
        ENDS,
        buckets=LATENESS_BUCKETS,
    ),
    counter("cloudrc_loop_busy_seconds_total", "Time spent in handling deadlines.", ENDS),
    counter(
        "cloudrc_words_dropped_total",
        "Words of teleop for another session, or without a number left, which are not passed on.",
        (CLOUD,),
    ),
    counter("cloudrc_loop_missed_periods_total", "Commands skipped by a late loop.", (CLOUD,)),
    counter(
        "cloudrc_recorder_dropped_records_total",
        "Records that did not reach the recording.",
        ENDS,
    ),
    gauge(
        "cloudrc_recorder_sync_age_seconds",
        "What a power cut would take of the recording: the time since the newest sync that is done"
        " began; absent without a recording, rising for good once it was given up.",
        ENDS,
    ),
    counter(
        "cloudrc_clock_steps_total",
        "Times that the wall clock was found to have been set, each told with its size as a fault;"
        " nothing that flies looks at it.",
        ENDS,
    ),
    *MISSIONS,
    *LINKS,
)

METRICS: Mapping[str, Metric] = MappingProxyType({metric.name: metric for metric in _ENTRIES})
"""All metrics by name."""


def of_role(role: str) -> list[Metric]:
    """List the metrics that a process of this role exposes."""
    return [metric for metric in _ENTRIES if role in metric.roles]
