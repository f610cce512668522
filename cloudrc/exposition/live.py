"""The current metrics of one process, computed from its records."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping
from typing import Any

from cloudrc.exposition.ends import CloudEnd, End, WorldEnd
from cloudrc.exposition.parts import Handlers, Readings, by_label, unlabelled
from cloudrc.exposition.table import (
    CLOUD,
    LINK,
    MISSION,
    MISSION_OUTCOMES,
    MISSION_STATES,
    RELEASE_PERCENTILES,
    STEP_PERCENTILES,
    TELEOP,
    WORLD,
    Labels,
    of_role,
)
from cloudrc.records import UNDER_WAY, Counted, MissionEvent, Record

COUNTS = {
    "cloudrc_sessions_refused_total": "busy",
    "cloudrc_guard_limited_total": "limited_{}",
    "cloudrc_guard_held_seconds_total": "held_seconds",
    "cloudrc_guard_starts_refused_total": "start_refused",
    "cloudrc_world_stalls_total": "stalls",
    "cloudrc_horizon_clamped_total": "horizon_clamped",
    "cloudrc_commands_frozen_total": "frozen",
    "cloudrc_words_dropped_total": "words_dropped",
    "cloudrc_loop_missed_periods_total": "missed_periods",
    "cloudrc_plugin_failures_total": "{}_failed",
    "cloudrc_recorder_dropped_records_total": "recorder_dropped",
    "cloudrc_api_requests_total": "api_served",
    "cloudrc_api_rejected_total": "api_{}",
    "cloudrc_missions_refused_total": "api_order_{}",
    "cloudrc_stream_dropped_events_total": "api_events_dropped",
    "cloudrc_audit_dropped_total": "api_audit_dropped",
    "cloudrc_journal_repaired_total": "journal_repaired",
    "cloudrc_link_datagrams_total": "{}",
    "cloudrc_link_restored_total": "restored",
    "cloudrc_link_released_early_total": "released_early",
    "cloudrc_dns_errors_total": "unresolved",
}
"""Metric -> name of its count in `Counted`, with the value of its label at {}."""
ONE_SHAPER = ("cloudrc_link_restored_total", "cloudrc_link_released_early_total")
"""Metrics that only the relay or only netem has: absent until counted."""
PERCENTILES: Mapping[str, tuple[str, Mapping[str, str]]] = {
    "cloudrc_link_release_error_seconds": ("release_error", RELEASE_PERCENTILES),
    "cloudrc_link_step_lateness_seconds": ("step_lateness", STEP_PERCENTILES),
}
"""Metric -> first part of its counts [ns], and label value -> name of the percentile."""


def read_counts(role: str, counts: Mapping[str, int]) -> Iterator[tuple[str, dict[Labels, float]]]:
    """Read the metrics of a role that are counts of its process."""
    for metric in of_role(role):
        pattern = COUNTS.get(metric.name)
        if pattern is None or (metric.name in ONE_SHAPER and pattern not in counts):
            continue
        values = next(iter(metric.labels.values()), None)
        if values is None:
            yield metric.name, {(): counts.get(pattern, 0)}
        else:
            yield metric.name, {(each,): counts.get(pattern.format(each), 0) for each in values}


class Link:
    """Metrics of a process that shapes one direction of the link or both.

    Attributes:
        tell: Returns the page /link.json: details that are not metrics.
    """

    def __init__(self, counts: Mapping[str, int]) -> None:
        """Set the counts of the process; nothing is shaped yet."""
        self.tell: Callable[[], str] = lambda: "{}\n"
        self._counts = counts
        self._shapers: dict[str, Labels] = {}
        self._delays: dict[str, float] = {}

    def shaped(self, shaper: str, direction: str, mode: str) -> None:
        """Set the shaper of a direction from now on.

        Args:
            shaper: "relay" or "netem".
            direction: "uplink" or "downlink".
            mode: The configured mode: "auto", "relay" or "netem".
        """
        self._shapers[direction] = (shaper, direction, mode)

    def asked(self, direction: str, delay: float) -> None:
        """Set the mean delay [s] that the profile sets for a direction from now on."""
        self._delays[direction] = delay

    def read(self) -> Readings:
        """Return the current values; unknown values are absent."""
        counts = dict(self._counts)  # one atomic copy: the loop's thread may count on
        readings: Readings = {
            "cloudrc_link_info": dict.fromkeys(list(self._shapers.values()), 1.0),
            "cloudrc_link_delay_seconds": by_label(dict(self._delays)),
        }
        for metric, (quantity, percentiles) in PERCENTILES.items():
            names = {label: f"{quantity}_{name}_ns" for label, name in percentiles.items()}
            readings[metric] = {
                (label,): counts[name] * 1e-9 for label, name in names.items() if name in counts
            }
        return readings


NO_WAYPOINT = -1
"""Waypoint index while no mission is active."""


class Mission:
    """Metrics of the mission, computed from its events."""

    def __init__(self, *, always: bool) -> None:
        """Set the state to idle: there is no mission yet.

        Args:
            always: True to expose these metrics before the first event; False in a process that
                may have no mission.
        """
        self._shown = always
        self._state, self._waypoint, self._reached = "idle", NO_WAYPOINT, 0
        self._ended = dict.fromkeys(MISSION_OUTCOMES, 0)

    def handlers(self) -> Handlers:
        """Map each class of records that this part uses to a handler."""
        return {MissionEvent: self._on_event}

    def _on_event(self, record: MissionEvent) -> None:
        self._shown = True
        event = record.event
        if event not in UNDER_WAY:
            self._ended[event if event in self._ended else "other"] += 1
            self._state = event if event in ("done", "cancelled") else "failed"
            self._waypoint = NO_WAYPOINT
        elif event == "reached":
            self._reached += 1
            self._waypoint = record.waypoint + 1
        elif event in ("held", "paused"):
            self._state = "held"
        elif event != "goto":
            self._state, self._waypoint = "flying", record.waypoint
        elif self._state != "held":  # a new mission; in HOLD, goto only moves the hold point
            self._state, self._waypoint = "starting", NO_WAYPOINT

    def read(self) -> Readings:
        """Return the current values; unknown values are absent."""
        if not self._shown:
            return {}
        return {
            "cloudrc_mission_state": unlabelled(MISSION_STATES.index(self._state)),
            "cloudrc_mission_waypoint": unlabelled(self._waypoint),
            "cloudrc_waypoints_reached_total": unlabelled(self._reached),
            "cloudrc_missions_total": by_label(self._ended),
        }


class LiveMetrics:
    """Current values of one role's metrics; one thread feeds them, any other thread may read them.

    Attributes:
        end: Metrics of this end of the tunnel; None in teleop and link.
        link: Metrics of the emulated link; None in all other processes.
    """

    def __init__(self, role: str, *, missions: bool = True) -> None:
        """Set the role; no record has been seen yet.

        Args:
            role: "world", "cloud", "teleop" or "link".
            missions: Whether to expose metrics of missions; False in a cloud whose teleop exposes
                them.
        """
        self._role = role
        self._counts: dict[str, int] = {}
        ends: dict[str, type[WorldEnd | CloudEnd]] = {WORLD: WorldEnd, CLOUD: CloudEnd}
        self.end: End | None = ends[role](self._counts) if role in ends else None
        self.link = Link(self._counts) if role == LINK else None
        mission = Mission(always=role == TELEOP) if missions and role in MISSION else None
        self._parts = [part for part in (self.end, self.link, mission) if part is not None]
        self._handlers: dict[type, Callable[[Any], None]] = {Counted: self._on_count}
        for source in (self.end, mission):
            self._handlers |= source.handlers() if source is not None else {}

    def _on_count(self, record: Counted) -> None:
        self._counts[record.name] = record.total

    def see(self, records: Iterable[Record]) -> None:
        """Process records of this process, oldest first, without blocking."""
        handlers = self._handlers
        for record in records:
            handle = handlers.get(type(record))
            if handle is not None:
                handle(record)

    def read(self) -> Readings:
        """Return the current values; unknown values are absent."""
        readings: Readings = dict(read_counts(self._role, dict(self._counts)))
        for part in self._parts:
            readings |= part.read()
        return readings
