"""The bridge from the API's threads to teleop's loop: calls go over, their results come back.

The machine belongs to one thread. Whoever else wants something of it leaves a call here, which the
loop makes between two deadlines. The bridge is bounded: a flood is refused, it does not pile up.
Each role has a lane of its own, so that readers cannot take an operator's place. Beside them is one
for the emergency stop, which waits for nobody.
"""

from __future__ import annotations

import threading
from collections import deque
from collections.abc import Callable
from concurrent.futures import Future
from contextvars import ContextVar
from typing import Any

from cloudrc.teleop.auth import OPERATOR, ROLES, Role
from cloudrc.teleop.service import MissionService
from cloudrc.teleop.store import ConflictError, UnavailableError

STARTING = "teleop is starting"
WAITING_MAX = 64
"""Calls of each role that wait at once."""
LANE: ContextVar[Role] = ContextVar("lane", default=OPERATOR)
"""Whose request is being served; set by the gate."""

Call = Callable[[MissionService, int], Any]
"""Service and now [ns] come in; what is answered goes out."""


class Bridge:
    """Calls on their way.

    Attributes:
        closed: Why no call is taken, in words; "" if they are.
        alarm: Tells the robot to stop its rotors past everything else, teleop's loop included; may
            be called from any thread.
        stops: How many urgent calls there have been.
    """

    def __init__(self) -> None:
        self.closed = STARTING
        self.alarm: Callable[[], object] = lambda: None
        self.stops = 0
        self._urgent: deque[tuple[Call, Future[Any]]] = deque(maxlen=WAITING_MAX)
        self._lanes: dict[Role, deque[tuple[Call, Future[Any]]]] = {r: deque() for r in ROLES}
        self._lock = threading.Lock()
        self._service: MissionService | None = None

    def open(self, service: MissionService) -> None:
        """Take calls for this service from now on; a stop that waits is told at once."""
        self._service, self.closed = service, ""
        if self._urgent:
            self.alarm()

    def close(self, why: str) -> None:
        """Take no calls from now on, and refuse those that wait for the start."""
        with self._lock:
            self.closed = why
            while self._urgent:
                self._urgent.popleft()[1].set_exception(UnavailableError(why))

    def submit(self, call: Call, *, urgent: bool = False) -> Future[Any]:
        """Leave a call in its lane, from any thread; an urgent one is made before all others.

        While teleop starts an urgent one alone is taken: it is made as the first.

        Raises:
            UnavailableError: If none is taken now.
        """
        future: Future[Any] = Future()
        with self._lock:
            if self.closed and not (urgent and self.closed == STARTING):
                raise UnavailableError(self.closed)
            if urgent:
                self.stops += 1
                self._urgent.append((call, future))
                return future
            lane = self._lanes[LANE.get()]
            if len(lane) >= WAITING_MAX:  # those that nobody waits for any more make room
                still = [waiting for waiting in lane if not waiting[1].cancelled()]
                lane.clear()
                lane.extend(still)
            if len(lane) >= WAITING_MAX:
                raise UnavailableError(f"{WAITING_MAX} requests wait already; try again")
            lane.append((call, future))
        return future

    def unless_stopped(self, call: Call) -> Call:
        """Make of a call one that is refused where an urgent one has passed it by."""
        known = self.stops

        def made(service: MissionService, now_ns: int) -> Any:
            if self.stops != known:
                raise ConflictError("an emergency stop was asked for since; acknowledge it anew")
            return call(service, now_ns)

        return made

    def take(self) -> list[Callable[[int], None]]:
        """Hand over the calls that wait, operators' first, for the loop's thread to make."""
        taken = self.take_urgent()
        with self._lock:
            for lane in self._lanes.values():
                while lane and len(taken) < WAITING_MAX:
                    taken.append(self._bound(*lane.popleft()))
        return taken

    def take_urgent(self) -> list[Callable[[int], None]]:
        """Hand over the urgent calls alone: before what they have led to is seen."""
        return [self._bound(*self._urgent.popleft()) for _ in range(len(self._urgent))]

    def _bound(self, call: Call, future: Future[Any]) -> Callable[[int], None]:
        def make(now_ns: int) -> None:
            service = self._service
            assert service is not None, "nothing is taken before it is open"
            if not future.set_running_or_notify_cancel():
                return
            try:
                future.set_result(call(service, now_ns))
            except Exception as error:  # whoever called has to hear of it
                future.set_exception(error)

        return make
