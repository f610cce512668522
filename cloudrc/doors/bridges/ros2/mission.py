# SPDX-License-Identifier: Apache-2.0

"""Say how the mission goes, for a topic, and fly to a pose, for an action of ROS 2."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from contextlib import suppress
from math import inf
from typing import Any, TypeAlias

from cloudrc.base.errors import CloudrcError
from cloudrc.doors.bridges.ros2.requests import RosRequests
from cloudrc.results.record.live import ERROR, OK, HealthStatus
from cloudrc.teleop.client import Api, describe_mission, describe_verdict, mission_path
from cloudrc.teleop.wire import ENDED, HELD
from cloudrc.wire.messages import Quaternion, Vector

LOOK_PERIOD = 0.2
"""Time between two looks at a mission [s]."""
Tell: TypeAlias = Callable[[Vector, float, float], object]
"""Gets position [m], distance that is left [m], and time since the beginning [s]."""
ARRIVED, DWELL = 0.1, 0.5
"""Distance from a goal inside a held mission that counts as reached [m], and for how long [s]."""


class MissionNews:
    """The newest mission, and the newest goal that was refused, with its reason."""

    def __init__(self, api: Api, requests: RosRequests) -> None:
        """Begin before any mission; `api` is that of teleop."""
        self._api, self._requests = api, requests
        self._mission: Mapping[str, Any] | None = None
        self._told: HealthStatus | None = None

    def look(self, state: Mapping[str, Any]) -> HealthStatus | None:
        """Return what has changed since the last look; `state` is the answer of `GET /v1/state`."""
        if not state:  # teleop has not answered
            return None
        now, before = state["mission"], self._mission
        if now is None and before is not None and before["state"] not in ENDED:
            with suppress(CloudrcError):  # the flight may end, and teleop with it
                now = self._api.get(mission_path(before["id"]))
        self._mission = now or before
        status = self._status()
        if status == self._told:
            return None
        self._told = status
        return status

    def _status(self) -> HealthStatus:
        mission, refusal = self._mission, self._requests.refusal
        level, text, values = OK, "no mission yet", dict[str, str]()
        if mission is not None:
            level = ERROR if mission["state"] == "failed" else OK
            text = describe_mission(mission)
            values = {key: str(mission[key]) for key in ("id", "name", "state")}
            values["waypoints reached"] = f"{len(mission['reached'])} of {mission['waypoints']}"
        if refusal:
            values["refused goal"], values["refused because"] = refusal
        return HealthStatus(level, "mission", text, values)


class Navigation:
    """Flies to a pose as an action of ROS asks for it."""

    def __init__(self, api: Api, requests: RosRequests) -> None:
        """Make it; `api` is that of teleop."""
        self._api, self._requests = api, requests
        self._newest = 0

    def fly(
        self,
        goal: tuple[str, Vector, Quaternion],
        wants_end: Callable[[], bool],
        tell: Tell,
    ) -> str:
        """Fly to a goal, its frame, position [m] and orientation; return why it did not get there.

        The robot holds if `wants_end()` becomes true. `tell` is called again and again. A newer
        goal ends this flight.
        """
        self._newest = number = self._newest + 1
        if why := self._requests.go_to(*goal):
            return why
        try:
            return self._follow(number, wants_end, tell)
        except CloudrcError as error:
            return str(error)

    def _follow(self, number: int, wants_end: Callable[[], bool], tell: Tell) -> str:
        mission = self._api.get("/v1/state")["mission"]
        mission = mission or self._api.get("/v1/missions")["missions"][-1]
        is_aside = mission["state"] == HELD  # the goal has no end of its own
        began, near_since = time.monotonic(), inf
        while self._newest == number:
            now, away = time.monotonic(), self._requests.distance
            tell(self._requests.position, away, now - began)
            is_there = away <= ARRIVED and self._requests.has_heading
            near_since = min(near_since, now) if is_there else inf
            if mission["state"] == "done" or (is_aside and now - near_since > DWELL):
                return ""
            if mission["state"] in ENDED:
                return describe_verdict(mission["verdict"])
            if is_aside and mission["state"] != HELD:
                return "somebody has resumed the mission"
            if wants_end():
                self._requests.stay() if is_aside else self._requests.serve("cancel")
                return "cancelled"
            time.sleep(LOOK_PERIOD)
            mission = self._api.get(mission_path(mission["id"]))
        return "a newer goal has come"
