"""The table of all Prometheus metrics: name, kind, meaning, closed label sets, who exposes it.

Names follow Prometheus' rules: prefix `cloudrc_`, base units, counters end in `_total`. Every
label has a closed set of values, so that one pod stays below 200 series.

The closed sets that labels take their values from, and the buckets of the histograms.

What one Prometheus metric is: its name, type, meaning, labels, and who exposes it.

The part of the table of metrics that is the standing check of the link.

The metrics of the emulated link: who shapes it, what was asked for, what became of datagrams.

The metrics of missions, of the API that takes them, and of the journal that keeps them.
"""

from __future__ import annotations

from collections.abc import Mapping
from enum import Enum
from types import MappingProxyType
from typing import NamedTuple

WORLD, CLOUD, TELEOP, LINK = "world", "cloud", "teleop", "link"
ROLES = (WORLD, CLOUD, TELEOP, LINK)
ENDS = (WORLD, CLOUD)
MISSION = (CLOUD, TELEOP)

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
"""What becomes of a datagram; all but "sent" are told by its receiver."""
ONLY_WORLD = {"stale", "range", "future", "hello", "unanswered"}
ONLY_CLOUD = {"accept_ignored"}
LIMITS = ("speed", "yaw_rate", "fence")
"""Of the guard."""
PLUGINS = ("estimator", "predictor", "controller")
GUARD_STATES = ("ground", "track", "hold", "land", "estop")
"""In the order of `cloudrc.messages.GuardState`."""
MISSION_STATES = ("idle", "starting", "flying", "held", "done", "failed", "cancelled")
"""In the order of `cloudrc.cloud.teleop.messages.State`."""
MISSION_OUTCOMES = (
    "done",
    "cancelled",
    "timed_out",
    "leg_timed_out",
    "world_restarted",
    "guard_stopped",
    "emergency_stopped",
    "taken_over",
    "end_lost",
    "other",
)
API_REFUSALS = ("token", "role", "busy", "slow")
"""Why the API does not serve: no valid token, a reader's token, too many requests or connections,
a client that dawdles."""
ORDER_REFUSALS = ("invalid", "conflict")
"""Why an order is not flown: a value that cannot be used, a mission in the way."""
BODIES = ("pipe", "board", "floor", "other")
"""Kinds of bodies: `pipe_2` is a "pipe", and what else a scene may have is "other"."""
LINK_OUTCOMES = ("received", "forwarded", "lost", "malformed", "overflow", "unread", "unsent")
"""As `cloudrc.link.relay.Lanes.outcomes` explains them."""
SHAPERS = ("relay", "netem")
LINK_MODES = ("auto", "relay", "netem")

DELAY_BUCKETS = (0.005, 0.01, 0.02, 0.05, 0.1, 0.15, 0.25, 1.0)
GAP_BUCKETS = (0.05, 0.25)
"""More than jitter makes of a period of 10 ms, and the age at which the guard holds; only two, for
a pod has less than 200 series."""
PERIOD_BUCKETS = (0.009, 0.0095, 0.0105, 0.011, 0.015, 0.02, 0.05, 0.1)
"""Around the 10 ms of both loops."""
LATENESS_BUCKETS = (0.0001, 0.0005, 0.001, 0.002, 0.005, 0.01, 0.05, 0.1)
RELEASE_PERCENTILES = {"50": "p50", "99": "p99", "99.9": "p999"}
"""Label -> how `cloudrc.link.lateness` names it."""
STEP_PERCENTILES = {"50": "p50", "99": "p99"}
"""Label -> how `cloudrc.link.netem_steps` names it."""

Labels = tuple[str, ...]


class Kind(Enum):
    """What Prometheus calls the type of a metric."""

    COUNTER = "counter"
    GAUGE = "gauge"
    HISTOGRAM = "histogram"


class Metric(NamedTuple):
    """One metric.

    Attributes:
        name: As it is scraped; a histogram adds `_bucket`, `_sum` and `_count`.
        kind: Its type.
        meaning: One sentence or two: the HELP text.
        roles: Which processes expose it.
        labels: Name -> all values that it may have.
        buckets: Upper bounds of a histogram, rising, in the metric's unit.
    """

    name: str
    kind: Kind
    meaning: str
    roles: tuple[str, ...]
    labels: Mapping[str, Labels] = MappingProxyType({})
    buckets: tuple[float, ...] = ()


def counter(name: str, meaning: str, roles: tuple[str, ...], **labels: Labels) -> Metric:
    """What only rises."""
    return Metric(name, Kind.COUNTER, meaning, roles, labels)


def gauge(name: str, meaning: str, roles: tuple[str, ...], **labels: Labels) -> Metric:
    """What is so now."""
    return Metric(name, Kind.GAUGE, meaning, roles, labels)


def delay(name: str, meaning: str, roles: tuple[str, ...]) -> Metric:
    """How often a delay was how long."""
    return Metric(name, Kind.HISTOGRAM, meaning, roles, buckets=DELAY_BUCKETS)


def numbered(names: Labels) -> str:
    """Say which number stands for which state."""
    return ", ".join(f"{number} {name}" for number, name in enumerate(names))


CHECK = (
    gauge(
        "cloudrc_link_believed",
        "1 if the direction that this end hears is proven to be what was asked for, 0 if it is"
        " not (/link.json of the same port says why); absent while there are too few datagrams to"
        " say.",
        ENDS,
        direction=DIRECTIONS,
    ),
)
"""Entries of the table."""


LINKS = (
    Metric(
        "cloudrc_link_info",
        Kind.GAUGE,
        "1; its labels say who shapes a direction of the link, and which mode was asked for.",
        (LINK,),
        {"shaper": SHAPERS, "direction": DIRECTIONS, "mode": LINK_MODES},
    ),
    gauge(
        "cloudrc_link_delay_seconds",
        "Mean one-way delay that the profile in force asks for.",
        (LINK,),
        direction=DIRECTIONS,
    ),
    gauge(
        "cloudrc_link_step_lateness_seconds",
        "How late netem's qdisc took the last 10,000 steps of its time line; absent without steps.",
        (LINK,),
        percentile=tuple(STEP_PERCENTILES),
    ),
    counter(
        "cloudrc_link_datagrams_total",
        "Datagrams at the shaper by what became of them.",
        (LINK,),
        outcome=LINK_OUTCOMES,
    ),
    counter(
        "cloudrc_link_restored_total",
        "How often another hand had removed or changed netem's qdisc, and it was put back.",
        (LINK,),
    ),
    gauge(
        "cloudrc_link_release_error_seconds",
        "How late datagrams left the relay in the last 10 s; absent with netem.",
        (LINK,),
        percentile=tuple(RELEASE_PERCENTILES),
    ),
    counter(
        "cloudrc_link_released_early_total",
        "Datagrams that left the relay before they were due: none, unless its code is wrong; absent"
        " with netem.",
        (LINK,),
    ),
    counter(
        "cloudrc_dns_errors_total",
        "Times that the peer's name could not be resolved; the last address known is kept.",
        (LINK,),
    ),
)
"""A part of the table."""


MISSIONS = (
    # Mission: in the process that flies it.
    gauge("cloudrc_mission_state", f"State of the mission: {numbered(MISSION_STATES)}.", MISSION),
    gauge("cloudrc_mission_waypoint", "Index of the waypoint flown to; -1 if none.", MISSION),
    counter("cloudrc_waypoints_reached_total", "Waypoints reached.", MISSION),
    counter("cloudrc_missions_total", "Missions ended.", MISSION, outcome=MISSION_OUTCOMES),
    # Teleop: its API and its journal.
    counter("cloudrc_api_requests_total", "Requests that the API has served.", (TELEOP,)),
    counter(
        "cloudrc_api_rejected_total",
        "Requests refused and connections cut off by the API.",
        (TELEOP,),
        reason=API_REFUSALS,
    ),
    counter(
        "cloudrc_missions_refused_total",
        "Orders that the API refused: of what cannot be flown, or while a mission is in the way.",
        (TELEOP,),
        reason=ORDER_REFUSALS,
    ),
    counter(
        "cloudrc_stream_dropped_events_total",
        "Events that were forgotten before a reader of the stream, who was too slow, had them.",
        (TELEOP,),
    ),
    counter(
        "cloudrc_audit_dropped_total",
        "Lines of the audit log that a slow or full disk did not take.",
        (TELEOP,),
    ),
    counter(
        "cloudrc_journal_repaired_total",
        "Times that the journal was found damaged and mended.",
        (TELEOP,),
    ),
)
"""A part of the table."""


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
