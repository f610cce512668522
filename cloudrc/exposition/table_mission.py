"""The metrics of missions, of the API that takes them, and of the journal that keeps them."""

from __future__ import annotations

from cloudrc.exposition.labels import (
    API_REFUSALS,
    MISSION,
    MISSION_OUTCOMES,
    MISSION_STATES,
    ORDER_REFUSALS,
    TELEOP,
)
from cloudrc.exposition.metric import counter, gauge, numbered

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
