"""The metrics of one process while it flies: records come in, readings go out.

What teleop's process exposes besides the mission: counts of its API and its journal.

What the emulated link exposes: who shapes which direction, and what became of the datagrams.

What the process that flies the mission exposes: its events become state, waypoint and counts.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from typing import Any

from cloudrc.exposition.ends import CloudEnd, End, WorldEnd
from cloudrc.exposition.parts import Handlers, Part, Readings, by, chosen, plain
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
from cloudrc.records import Counted, MissionEvent, Record


class Api:
    """Requests to the API, and what became of them."""

    def __init__(self) -> None:
        """Begin with none."""
        self._counts: dict[str, int] = {}

    def handlers(self) -> Handlers:
        """See `Part`."""
        return {Counted: self._see_count}

    def _see_count(self, record: Counted) -> None:
        self._counts[record.name] = record.total

    def read(self) -> Readings:
        """See `Part`."""
        of_api = {name.removeprefix("api_"): count for name, count in self._counts.items()}
        return {
            "cloudrc_api_requests_total": plain(of_api.get("served", 0)),
            "cloudrc_api_rejected_total": by(chosen(API_REFUSALS, of_api)),
            "cloudrc_missions_refused_total": by(
                {reason: of_api.get(f"order_{reason}", 0) for reason in ORDER_REFUSALS}
            ),
            "cloudrc_stream_dropped_events_total": plain(of_api.get("events_dropped", 0)),
            "cloudrc_audit_dropped_total": plain(of_api.get("audit_dropped", 0)),
            "cloudrc_journal_repaired_total": plain(of_api.get("journal_repaired", 0)),
        }


_OF_ONE_SHAPER = {
    "cloudrc_link_restored_total": "restored",
    "cloudrc_link_released_early_total": "released_early",
}
"""Metric -> what the one shaper that knows it calls the count."""


class Link:
    """One process that shapes one direction or both.

    Attributes:
        tell: Says as JSON what its metrics have no words for.
    """

    def __init__(self) -> None:
        """Begin before anything is shaped."""
        self.tell: Callable[[], str] = lambda: "{}\n"
        self._shapers: dict[str, Labels] = {}
        self._delays: dict[str, float] = {}
        self._counts: dict[str, int] = {}

    def handlers(self) -> Handlers:
        """See `Part`."""
        return {Counted: self._see_count}

    def shaped(self, shaper: str, direction: str, mode: str) -> None:
        """Say who shapes a direction from now on.

        Args:
            shaper: "relay" or "netem".
            direction: "uplink" or "downlink".
            mode: What was asked for: "auto", "relay" or "netem".
        """
        assert shaper in SHAPERS
        assert direction in DIRECTIONS
        assert mode in LINK_MODES
        self._shapers[direction] = (shaper, direction, mode)

    def asked(self, direction: str, delay: float) -> None:
        """Say which mean delay [s] a direction is asked to have from now on."""
        assert direction in DIRECTIONS
        self._delays[direction] = delay

    def _see_count(self, record: Counted) -> None:
        self._counts[record.name] = record.total

    def read(self) -> Readings:
        """See `Part`."""
        return {
            "cloudrc_link_info": dict.fromkeys(list(self._shapers.values()), 1.0),
            "cloudrc_link_delay_seconds": by(dict(self._delays)),
            "cloudrc_link_datagrams_total": by(chosen(LINK_OUTCOMES, self._counts)),
            "cloudrc_dns_errors_total": plain(self._counts.get("unresolved", 0)),
            "cloudrc_link_release_error_seconds": self._late("release_error", RELEASE_PERCENTILES),
            "cloudrc_link_step_lateness_seconds": self._late("step_lateness", STEP_PERCENTILES),
        } | self._of_one_shaper()

    def _of_one_shaper(self) -> Readings:
        """Count what netem or the relay alone can tell; what nobody has told is not there."""
        counts = dict(self._counts)  # copied at once: the other thread may go on
        return {name: plain(counts[one]) for name, one in _OF_ONE_SHAPER.items() if one in counts}

    def _late(self, what: str, percentiles: Mapping[str, str]) -> dict[Labels, float]:
        """Say how late a relay was, or a qdisc was stepped [s]; empty if nobody has told."""
        counts = dict(self._counts)  # copied at once: the other thread may go on
        named = {label: f"{what}_{name}_ns" for label, name in percentiles.items()}
        return by({label: counts[name] * 1e-9 for label, name in named.items() if name in counts})


UNDER_WAY = ("started", "reached", "held", "resumed", "goto", "paused")
"""Events of a mission that goes on; every other event ends it."""
NO_WAYPOINT = -1


class Mission:
    """The mission as its events tell of it."""

    def __init__(self, *, always: bool) -> None:
        """Begin with none.

        Args:
            always: Expose it before its first event: False in a process that may have no mission.
        """
        self._shown = always
        self._state, self._waypoint, self._reached = "idle", NO_WAYPOINT, 0
        self._ended = dict.fromkeys(MISSION_OUTCOMES, 0)

    def handlers(self) -> Handlers:
        """See `Part`."""
        return {MissionEvent: self._see_event}

    def _see_event(self, record: MissionEvent) -> None:
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
        elif self._state != "held":  # a mission of its own; else only the point where it is held
            self._state, self._waypoint = "starting", NO_WAYPOINT

    def _end(self, event: str) -> None:
        self._ended[event if event in self._ended else "other"] += 1
        self._state = event if event in ("done", "cancelled") else "failed"
        self._waypoint = NO_WAYPOINT

    def read(self) -> Readings:
        """See `Part`."""
        if not self._shown:
            return {}
        return {
            "cloudrc_mission_state": plain(MISSION_STATES.index(self._state)),
            "cloudrc_mission_waypoint": plain(self._waypoint),
            "cloudrc_waypoints_reached_total": plain(self._reached),
            "cloudrc_missions_total": by(self._ended),
        }


class Live:
    """The values of one role's metrics; one thread feeds it, any other may read it.

    Attributes:
        end: Of the tunnel; None in a process that is none.
        link: The emulated link; None in a process that is none.
    """

    def __init__(self, role: str, *, missions: bool = True) -> None:
        """Begin with nothing seen.

        Args:
            role: "world", "cloud", "teleop" or "link".
            missions: Whether they are told here; False in a cloud whose teleop tells them.
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
        """Take in records of this process, oldest first; never waits."""
        handlers = self._handlers
        for record in records:
            handle = handlers.get(type(record))
            if handle is not None:
                handle(record)

    def read(self) -> Readings:
        """Say all that is known now; what is not known is absent."""
        readings: Readings = {}
        for part in self._parts:
            readings |= part.read()
        return readings
