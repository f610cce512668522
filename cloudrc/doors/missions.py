# SPDX-License-Identifier: Apache-2.0

"""Read missions, post one to the API of teleop, and follow it to its verdict."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, TypeVar

from cloudrc.base.errors import TimedOutError
from cloudrc.teleop.client import Api, UnreachableError, describe_mission, mission_path

BEGINS = ("queued", "starting")
"""States of a mission that nobody has followed yet."""
POLL_PERIOD = 0.5
"""Time between two requests for the state of a mission [s]."""
Tell = Callable[[str], None]
"""Function that receives one line of text."""

_Answer = TypeVar("_Answer")
Json = dict[str, Any]


def read_mission(name: str, shown: str = "") -> Json:
    """Read a mission file, or a mission that cloudrc ships; the API checks the content later.

    `shown` is the mission's name in lists and messages, by default the name of the file.
    """
    from cloudrc.config import shipped

    mission = shipped.read("mission", name, Path()).tree
    return {"name": Path(name).stem, **mission, **({"name": shown} if shown else {})}


class MissionFollower:
    """Follows one mission until its verdict, even if the API restarts in a new pod meanwhile."""

    def __init__(
        self, api: Api, patience: float, lease: float = 0.0, tell: Tell = lambda text: None
    ) -> None:
        """Store the API; `patience` is the time limit for an API that does not answer [s].

        After this time the methods raise a TimedOutError; other errors are those of `Api.post`.
        Teleop cancels a posted mission `lease` [s] after the end of this follower; 0: never. `tell`
        receives each line about the mission.
        """
        self._api, self._patience, self._lease, self._tell = api, patience, lease, tell
        self._last_event = 0

    def post(self, mission: Mapping[str, Any]) -> str:
        """Post a mission; return its id."""
        leased = {**mission, "lease_s": self._lease} if self._lease else mission
        view = self._retry(lambda: self._api.post("/v1/missions", leased))
        text = f"mission {view['id']}: {view['state']}, waypoints: {view['waypoints']}"
        if view["state"] not in BEGINS:
            text = f"following {describe_mission(view)}"
        elif mission.get("start", "spawn") == "spawn":
            text += "; the robot is set back to its spawn at the start"
        self._tell(f"{self._api.place}: {text}" if self._api.place else text)
        return str(view["id"])

    def follow(self, mission_id: str) -> Json:
        """Tell the events of a mission until it has ended; return its verdict."""
        path = mission_path(mission_id)
        while True:
            view = self._retry(
                lambda: self._api.post(f"{path}/renew") if self._lease else self._api.get(path)
            )
            for event in view["events"]:
                if event["id"] > self._last_event:
                    self._last_event = event["id"]
                    self._tell(f"{event['time_s']:7.2f} s  {event['text']}")
            if view["verdict"] is not None:
                return dict(view["verdict"])
            time.sleep(POLL_PERIOD)

    def _retry(self, request: Callable[[], _Answer]) -> _Answer:
        """Repeat a request until the API answers; raise a TimedOutError if this takes too long."""
        deadline, reported = time.monotonic() + self._patience, False
        while True:
            try:
                return request()
            except UnreachableError as error:
                if time.monotonic() > deadline:
                    raise TimedOutError(f"{error}; gave up after {self._patience:g} s") from None
                if not reported:
                    self._tell(f"{error}; waiting")
                    reported = True
            time.sleep(POLL_PERIOD)
