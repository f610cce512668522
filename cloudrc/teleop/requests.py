# SPDX-License-Identifier: Apache-2.0

"""Send operator requests over a lossy link: repeat a request until the robot has carried it out."""

from __future__ import annotations

from cloudrc.teleop.wire import RobotStatus
from cloudrc.wire.messages import GuardState, OperatorRequest, Request, Start

# To look up a member takes time.
GROUND, HOLD, ESTOP = GuardState.GROUND, GuardState.HOLD, GuardState.ESTOP

REPEAT_NS = 100_000_000
"""Time between two copies of a request [ns]."""
UNNUMBERED = 0
"""Number of a request that has no number yet."""
NOT_ENDED = (-1, 0)
"""Epoch and request number that mean: the robot has not ended a mission."""
IDLE_NS = 3_000_000_000
"""Longest time for which a robot may hold or stand in a mission [ns]. After it, teleop sends the
start again, because somebody else has probably stopped the robot."""
PREDECESSORS = 1_000
"""A new teleop process raises the request number by at least this value, because telemetry may not
show the last requests of the earlier process yet."""
CLOCK_MAX = 65_536
"""A new teleop process adds the time in units of 100 ms, modulo this value, to its first request
number, so that two new processes have different numbers."""


class RequestSender:
    """Repeat the newest request at 10 Hz until telemetry shows that the robot has carried it out.

    A new request replaces the previous request and gets a higher number, because the robot carries
    out requests with rising numbers only. Nothing is sent before the first telemetry. While no
    request is pending, the sender repeats the mission's progress until the robot has stored it.
    Cloud, not this class, numbers and repeats emergency stops.
    """

    def __init__(self) -> None:
        self._seen: RobotStatus | None = None
        self._pending: OperatorRequest | None = None
        self._next: OperatorRequest | None = None  # sent after the pending request
        self._progress = OperatorRequest(UNNUMBERED, Request.PROGRESS)
        self._touch = ""  # name of the body that the mission has to touch, if any
        self._number = UNNUMBERED
        self._asked_epoch = 0
        self._ended = NOT_ENDED  # epoch and number of the last END; NOT_ENDED after a START
        self._is_started = False  # whether the last request that was carried out is a START
        self._flies_ns = 0  # when the robot last flew its mission
        self._due_ns = 0

    @property
    def settled(self) -> bool:
        """Whether the robot has carried out all requests."""
        return self._pending is None

    @property
    def waits(self) -> bool:
        """Whether the robot ignores commands: its guard is in GROUND, or its mission has ended."""
        seen = self._seen
        if seen is None or self._next is not None:
            return False
        return seen.guard is GROUND or (seen.epoch, seen.mission) == self._ended

    def ask(self, request: Request, start: Start = Start.SPAWN, *, after: bool = False) -> None:
        """Begin to repeat a request until the robot carries it out; drop the pending request.

        If `after` is True, the pending request is not dropped, but finished first. `start` is the
        place where a mission starts; only a START needs it.
        """
        asked = self._progress._replace(request=request, start=start)
        if request is Request.START:
            asked = asked._replace(touch=self._touch)
        if self._pending is None or not after:
            self._pending, self._next = asked, None
        elif self._pending.request is not request:
            self._next = asked

    def forget(self) -> None:
        """Drop all requests, because another teleop or an emergency stop controls the robot."""
        self._is_started = False
        self._pending = self._next = None

    def begin(self, mission_id: int, reached: int, *, touch: str = "") -> None:
        """Set the mission of the following requests; it has to touch the body `touch`, if any."""
        self._touch = touch
        self.report(mission_id, reached)

    def report(self, mission_id: int, reached: int) -> None:
        """Set the progress that every request contains: mission and number of reached waypoints."""
        self._progress = self._progress._replace(mission_id=mission_id, reached=reached)
        if self._pending is None:
            self._due_ns = 0

    def see(self, seen: RobotStatus, now_ns: int) -> Request | None:
        """Process telemetry of `now_ns` [ns]; return the request that it confirms, else None."""
        self._seen, pending = seen, self._pending
        if pending is None:
            self._repeat_start_if_lost(seen, now_ns)
            return None
        self._flies_ns = now_ns
        if not self._is_acknowledged(pending, seen):
            return None
        self._pending, self._next = self._next, None
        self._is_started = pending.request is Request.START and self._pending is None
        if pending.request is Request.START:
            self._ended = NOT_ENDED
        elif pending.request is not Request.ACKNOWLEDGE:  # an acknowledgement ends no mission
            self._ended = seen.epoch, seen.mission
        return pending.request

    def due(self, now_ns: int) -> OperatorRequest | None:
        """Return the request to send at `now_ns` [ns]; None if no request is due."""
        pending, seen = self._pending, self._seen
        if seen is None:
            return None
        if pending is None:
            return self._progress_due(seen, now_ns)
        # A new number is needed if telemetry shows a higher number (of an emergency stop), or the
        # same number (of an earlier teleop; `see` would have removed this teleop's request).
        if pending.number == UNNUMBERED or seen.mission >= pending.number:
            rise = 1 if self._number else PREDECESSORS + now_ns // REPEAT_NS % CLOCK_MAX
            self._number = max(self._number, seen.mission) + rise
            pending = self._pending = pending._replace(number=self._number)
            self._asked_epoch = seen.epoch
        elif now_ns < self._due_ns:
            return None
        self._due_ns = now_ns + REPEAT_NS
        return pending._replace(epoch=seen.epoch)

    def _repeat_start_if_lost(self, seen: RobotStatus, now_ns: int) -> None:
        """Send the request START again if another sender has probably stopped the robot."""
        ours = self._is_started and seen.mission_id == self._progress.mission_id
        if not ours or seen.guard not in (GROUND, HOLD):
            self._flies_ns = now_ns
        if ours and seen.guard <= HOLD:
            if 0 < self._number < seen.mission or now_ns - self._flies_ns >= IDLE_NS:
                self.ask(Request.START, Start.HERE)

    def _progress_due(self, seen: RobotStatus, now_ns: int) -> OperatorRequest | None:
        """Return the request that stores the mission's progress in the robot; None if not due."""
        progress = self._progress
        same = seen.mission_id == progress.mission_id != 0
        if not same or seen.reached >= progress.reached or now_ns < self._due_ns:
            return None
        self._due_ns = now_ns + REPEAT_NS
        return progress._replace(epoch=seen.epoch)

    def _is_acknowledged(self, pending: OperatorRequest, seen: RobotStatus) -> bool:
        if pending.number == UNNUMBERED or seen.mission != pending.number:
            return False
        if pending.request is Request.ACKNOWLEDGE and seen.guard is ESTOP:
            return False  # cloud has given the same number to another copy of the stop
        # Telemetry of the old epoch was sent before the reset to the spawn.
        from_spawn = pending.request is Request.START and pending.start is Start.SPAWN
        return not from_spawn or seen.epoch != self._asked_epoch
