"""The current metrics of one process, computed from its records: API, link, mission and both ends.

The module `ends` has the metrics of the tunnel's ends.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from typing import Any

from cloudrc.exposition.ends import CloudEnd, End, WorldEnd
from cloudrc.exposition.parts import Handlers, Part, Readings, by_label, select, unlabelled
from cloudrc.exposition.table import (
    API_REFUSALS,
    CLOUD,
    DIRECTIONS,
    LINK,
    LINK_MODES,
    LINK_OUTCOMES,
    MISSION,
    MISSION_OUTCOMES,
    MISSION_STATES,
    ORDER_REFUSALS,
    RELEASE_PERCENTILES,
    SHAPERS,
    STEP_PERCENTILES,
    TELEOP,
    WORLD,
    Labels,
)
from cloudrc.records import UNDER_WAY, Counted, MissionEvent, Record


class Api:
    """Counts of teleop's API and journal."""

    def __init__(self) -> None:
        """Set all counts to 0."""
        self._counts: dict[str, int] = {}

    def handlers(self) -> Handlers:
        """Map each class of records that this part uses to a handler."""
        return {Counted: self._on_count}

    def _on_count(self, record: Counted) -> None:
        self._counts[record.name] = record.total

    def read(self) -> Readings:
        """Return the current values; unknown values are absent."""
        counts = {name.removeprefix("api_"): count for name, count in self._counts.items()}
        return {
            "cloudrc_api_requests_total": unlabelled(counts.get("served", 0)),
            "cloudrc_api_rejected_total": by_label(select(API_REFUSALS, counts)),
            "cloudrc_missions_refused_total": by_label(
                {reason: counts.get(f"order_{reason}", 0) for reason in ORDER_REFUSALS}
            ),
            "cloudrc_stream_dropped_events_total": unlabelled(counts.get("events_dropped", 0)),
            "cloudrc_audit_dropped_total": unlabelled(counts.get("audit_dropped", 0)),
            "cloudrc_journal_repaired_total": unlabelled(counts.get("journal_repaired", 0)),
        }


_SINGLE_SHAPER_COUNTS = {
    "cloudrc_link_restored_total": "restored",
    "cloudrc_link_released_early_total": "released_early",
}
"""Metric that only the relay or only netem has -> name of its count."""


class Link:
    """Metrics of a process that shapes one direction of the link or both.

    Attributes:
        tell: Returns the page /link.json: details that are not metrics.
    """

    def __init__(self) -> None:
        """Create the metrics; nothing is shaped or counted yet."""
        self.tell: Callable[[], str] = lambda: "{}\n"
        self._shapers: dict[str, Labels] = {}
        self._delays: dict[str, float] = {}
        self._counts: dict[str, int] = {}

    def handlers(self) -> Handlers:
        """Map each class of records that this part uses to a handler."""
        return {Counted: self._on_count}

    def shaped(self, shaper: str, direction: str, mode: str) -> None:
        """Set the shaper of a direction from now on.

        Args:
            shaper: "relay" or "netem".
            direction: "uplink" or "downlink".
            mode: The configured mode: "auto", "relay" or "netem".
        """
        assert shaper in SHAPERS
        assert direction in DIRECTIONS
        assert mode in LINK_MODES
        self._shapers[direction] = (shaper, direction, mode)

    def asked(self, direction: str, delay: float) -> None:
        """Set the mean delay [s] that the profile sets for a direction from now on."""
        assert direction in DIRECTIONS
        self._delays[direction] = delay

    def _on_count(self, record: Counted) -> None:
        self._counts[record.name] = record.total

    def read(self) -> Readings:
        """Return the current values; unknown values are absent."""
        return {
            "cloudrc_link_info": dict.fromkeys(list(self._shapers.values()), 1.0),
            "cloudrc_link_delay_seconds": by_label(dict(self._delays)),
            "cloudrc_link_datagrams_total": by_label(select(LINK_OUTCOMES, self._counts)),
            "cloudrc_dns_errors_total": unlabelled(self._counts.get("unresolved", 0)),
            "cloudrc_link_release_error_seconds": self._percentiles(
                "release_error", RELEASE_PERCENTILES
            ),
            "cloudrc_link_step_lateness_seconds": self._percentiles(
                "step_lateness", STEP_PERCENTILES
            ),
        } | self._single_shaper_counts()

    def _single_shaper_counts(self) -> Readings:
        """Read the counts that only the relay or only netem has; uncounted values are absent."""
        counts = dict(self._counts)  # one atomic copy: the loop's thread may count on
        return {
            name: unlabelled(counts[one])
            for name, one in _SINGLE_SHAPER_COUNTS.items()
            if one in counts
        }

    def _percentiles(self, quantity: str, percentiles: Mapping[str, str]) -> dict[Labels, float]:
        """Read the percentiles of a lateness [s]; empty before the first count."""
        counts = dict(self._counts)  # one atomic copy: the loop's thread may count on
        names = {label: f"{quantity}_{name}_ns" for label, name in percentiles.items()}
        return by_label(
            {label: counts[name] * 1e-9 for label, name in names.items() if name in counts}
        )


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
            self._end(event)
        elif event == "reached":
            self._reached += 1
            self._waypoint = record.waypoint + 1
        elif event in ("held", "paused"):
            self._state = "held"
        elif event != "goto":
            self._state, self._waypoint = "flying", record.waypoint
        elif self._state != "held":  # a new mission; in HOLD, goto only moves the hold point
            self._state, self._waypoint = "starting", NO_WAYPOINT

    def _end(self, event: str) -> None:
        self._ended[event if event in self._ended else "other"] += 1
        self._state = event if event in ("done", "cancelled") else "failed"
        self._waypoint = NO_WAYPOINT

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
        self.end: End | None = {WORLD: WorldEnd, CLOUD: CloudEnd}.get(role, lambda: None)()
        self.link = Link() if role == LINK else None
        mission = Mission(always=role == TELEOP) if missions and role in MISSION else None
        api = Api() if role == TELEOP else None
        parts: tuple[Part | None, ...] = (self.end, self.link, mission, api)
        self._parts = [part for part in parts if part is not None]
        self._handlers: dict[type, Callable[[Any], None]] = {}
        for part in self._parts:
            self._handlers.update(part.handlers())

    def see(self, records: Iterable[Record]) -> None:
        """Process records of this process, oldest first, without blocking."""
        handlers = self._handlers
        for record in records:
            handle = handlers.get(type(record))
            if handle is not None:
                handle(record)

    def read(self) -> Readings:
        """Return the current values; unknown values are absent."""
        readings: Readings = {}
        for part in self._parts:
            readings |= part.read()
        return readings
