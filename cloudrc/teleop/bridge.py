"""Carry calls from the API's thread to teleop's loop, and their results back.

Only the loop's thread may use the mission service. The API queues a call, and the loop makes the
call between two deadlines. The number of queued calls is bounded. An emergency stop and a hold do
not wait behind other calls, and the queue always has room for them.
"""

from __future__ import annotations

import threading
from collections import deque
from collections.abc import Callable
from concurrent.futures import Future
from typing import Any, Literal, TypeAlias

from cloudrc.teleop.service import MissionService
from cloudrc.teleop.store import ConflictError, UnavailableError

STARTING = "teleop is starting"
WAITING_MAX = 64
"""Limit of the calls that wait at the same time."""
Call: TypeAlias = Callable[[MissionService, int], Any]
"""Function that takes the service and the current time [ns] and returns the answer."""
Waiting: TypeAlias = tuple[Call, Future[Any]]
Urgent: TypeAlias = Literal["stop", "hold"]


class Bridge:
    """Queue the API's calls for teleop's loop.

    Attributes:
        closed: Why no call is accepted, in words; "" if calls are accepted.
        alarm: Sends an emergency stop directly to cloud and returns whether cloud has accepted it.
            It bypasses teleop's loop, does not block, and may be called from any thread.
        overtakings: Number of stops and holds so far.
    """

    def __init__(self) -> None:
        self.closed = STARTING
        self.alarm: Callable[[], bool] = lambda: True
        self.overtakings = 0
        self._urgent: dict[Urgent, Waiting] = {}
        self._waiting: deque[Waiting] = deque()
        self._lock = threading.Lock()
        self._service: MissionService | None = None

    def open(self, service: MissionService) -> None:
        """Accept calls for `service`; if a stop already waits, send the alarm."""
        self._service, self.closed = service, ""
        if "stop" in self._urgent:
            self.alarm()

    def close(self, why: str) -> None:
        """Refuse calls from now on; also refuse a waiting stop or hold."""
        with self._lock:
            self.closed = why
            while self._urgent:
                self._urgent.popitem()[1][1].set_exception(UnavailableError(why))

    def submit(self, call: Call, urgent: Urgent | None = None) -> Future[Any]:
        """Queue a call; any thread may do this.

        If a stop is already queued, a second stop gets the result of the first; the same holds for
        a hold. While teleop starts, the bridge accepts only a stop; the loop makes it first.

        Raises:
            UnavailableError: If no call is accepted, or if too many calls wait.
        """
        future: Future[Any] = Future()
        with self._lock:
            if self.closed and not (urgent == "stop" and self.closed == STARTING):
                raise UnavailableError(self.closed)
            if urgent is not None:
                self.overtakings += 1
                return self._urgent.setdefault(urgent, (call, future))[1]
            if len(self._waiting) >= WAITING_MAX:  # remove those whose client no longer waits
                self._waiting = deque(each for each in self._waiting if not each[1].cancelled())
            if len(self._waiting) >= WAITING_MAX:
                raise UnavailableError(f"{WAITING_MAX} requests wait already; try again")
            self._waiting.append((call, future))
        return future

    def unless_overtaken(self, call: Call) -> Call:
        """Wrap a call so that it fails if a stop or a hold overtakes it: no robot may move then."""
        known = self.overtakings

        def checked(service: MissionService, now_ns: int) -> Any:
            if self.overtakings != known:
                raise ConflictError("a stop or a hold was asked for since; look, then ask again")
            return call(service, now_ns)

        return checked

    def take(self) -> list[Callable[[int], None]]:
        """Return all queued calls for the loop: first a stop, then a hold, then the others."""
        with self._lock:
            taken = [self._urgent.pop(each) for each in ("stop", "hold") if each in self._urgent]
            taken += self._waiting
            self._waiting.clear()
        return [self._bound(*waiting) for waiting in taken]

    def take_urgent(self) -> list[Callable[[int], None]]:
        """Return only a queued stop; the loop makes it before it processes new telemetry."""
        with self._lock:
            stop = self._urgent.pop("stop", None)
        return [] if stop is None else [self._bound(*stop)]

    def _bound(self, call: Call, future: Future[Any]) -> Callable[[int], None]:
        def make(now_ns: int) -> None:
            service = self._service
            assert service is not None, "calls are taken after `open` only"
            if not future.set_running_or_notify_cancel():
                return
            try:
                future.set_result(call(service, now_ns))
            except Exception as error:  # the client has to get it
                future.set_exception(error)

        return make
