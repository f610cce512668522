"""The closed sets that labels take their values from, and the buckets of the histograms."""

from __future__ import annotations

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
"""As `cloudrc.link.relay_lanes.Lanes.outcomes` explains them."""
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
"""Label -> how `cloudrc.link.relay_errors` names it."""
STEP_PERCENTILES = {"50": "p50", "99": "p99"}
"""Label -> how `cloudrc.link.netem_steps` names it."""

Labels = tuple[str, ...]
