"""Carry calls from the API's thread to teleop's loop, and their results back.

The mission service belongs to the loop's thread. The API leaves a call here, and the loop makes the
call between two deadlines. The number of waiting calls is bounded. An emergency stop and a hold do
not wait behind other calls, and they always have room.
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
"""Function of the service and the current time [ns] that returns the answer."""
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
        """Accept calls for `service`; send the alarm of a stop that already waits."""
        self._service, self.closed = service, ""
        if "stop" in self._urgent:
            self.alarm()

    def close(self, why: str) -> None:
        """Refuse calls from now on, and also the stop that waits for the start."""
        with self._lock:
            self.closed = why
            while self._urgent:
                self._urgent.popitem()[1][1].set_exception(UnavailableError(why))

    def submit(self, call: Call, urgent: Urgent | None = None) -> Future[Any]:
        """Queue a call, from any thread.

        A stop or hold that waits already is not queued a second time: both requests get its result.
        While teleop starts, only a stop is accepted; it is the first call to be made.

        Raises:
            UnavailableError: If no call is accepted, or too many wait.
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
        """Make a call that is refused if a stop or a hold overtakes it: the robot must not move."""
        known = self.overtakings

        def checked(service: MissionService, now_ns: int) -> Any:
            if self.overtakings != known:
                raise ConflictError("a stop or a hold was asked for since; look, then ask again")
            return call(service, now_ns)

        return checked

    def take(self) -> list[Callable[[int], None]]:
        """Return all calls for the loop to make: first a stop, then a hold, then the others."""
        with self._lock:
            taken = [self._urgent.pop(each) for each in ("stop", "hold") if each in self._urgent]
            taken += self._waiting
            self._waiting.clear()
        return [self._bound(*waiting) for waiting in taken]

    def take_urgent(self) -> list[Callable[[int], None]]:
        """Return the stop alone, for the loop to make before it looks at new telemetry."""
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
