"""A mission followed to its end: the API's events become lines, its verdict an exit code.

The API may go away for a while, since the cloud pod may be replaced in flight.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, TypeVar

from cloudrc.cli.mission_http import Api, UnreachableError, path_of
from cloudrc.errors import CloudrcError

PERIOD = 0.5
"""Between two looks at a mission [s]."""
PATIENCE = 180.0
"""How long the API may be away: a pod on another node has to load its image [s]."""
TERMINATION_LOG = Path("/dev/termination-log")
"""In a pod: what `kubectl describe` shows of a container that has ended."""

_Answer = TypeVar("_Answer")


class WaitedTooLongError(CloudrcError):
    """The API was away for too long."""

    exit_code = 4


class Follower:
    """Follows one mission, through restarts of the API."""

    def __init__(
        self,
        api: Api,
        write: Callable[[str], None],
        patience: float | None = None,
    ) -> None:
        """Begin to follow.

        Args:
            api: Of teleop.
            write: Gets a line for everything that happens.
            patience: How long the API may be away [s]; None for `PATIENCE`.
        """
        self._api, self._write = api, write
        self._patience = PATIENCE if patience is None else patience
        self._told = 0

    def post(self, mission: Mapping[str, Any]) -> dict[str, Any]:
        """Post a mission, as soon as the API is there; raises what `Api.post` raises."""
        view = self._insist(lambda: self._api.post("/v1/missions", mission))
        self._write(f"mission {view['id']}: {view['state']}, waypoints: {view['waypoints']}")
        return dict(view)

    def follow(self, mission_id: str) -> dict[str, Any]:
        """Write what happens until the mission has ended.

        Returns:
            Its verdict, as the API gives it.
        """
        while True:
            view = self._insist(lambda: self._api.get(path_of(mission_id)))
            for event in view["events"]:
                if event["id"] > self._told:
                    self._told = event["id"]
                    self._write(f"{event['time_s']:7.2f} s  {event['text']}")
            if view["verdict"] is not None:
                return dict(view["verdict"])
            time.sleep(PERIOD)

    def _insist(self, ask: Callable[[], _Answer]) -> _Answer:
        """Ask until there is an answer, or patience ends."""
        until, told = time.monotonic() + self._patience, False
        while True:
            try:
                return ask()
            except UnreachableError as error:
                if time.monotonic() > until:
                    raise WaitedTooLongError(
                        f"{error}; given up after {self._patience:g} s"
                    ) from None
                if not told:
                    self._write(f"{error}; waiting")
                    told = True
            time.sleep(PERIOD)


def in_words(verdict: Mapping[str, Any]) -> str:
    """Say a verdict in one line."""
    word = verdict["outcome"].upper()
    failures = [f"{failure['code']}: {failure['text']}" for failure in verdict["failures"]]
    if not failures:
        return f"{word}: every waypoint reached, every criterion met"
    return f"{word}: {'; also '.join(failures)}"


def leave_message(text: str, path: Path = TERMINATION_LOG) -> None:
    """Tell Kubernetes how it ended, if this is a pod."""
    try:
        if path.exists():
            path.write_text(text + "\n", encoding="utf-8")
    except OSError:
        pass  # the log's last line says the same, and is the fallback
