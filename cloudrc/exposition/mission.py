"""What the process that flies the mission exposes: its events become state, waypoint and counts."""

from __future__ import annotations

from cloudrc.exposition.labels import MISSION_OUTCOMES, MISSION_STATES
from cloudrc.exposition.part import Handlers, Readings, by, plain
from cloudrc.records import MissionEvent

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
