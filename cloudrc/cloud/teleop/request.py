"""Requests over a lossy link: what to ask of the robot comes in, repeated requests go out."""

from __future__ import annotations

from cloudrc.cloud.teleop.messages import Seen
from cloudrc.messages import OperatorRequest, Request, Start

REPEAT_NS = 100_000_000
"""Time between two copies of a request [ns]."""
UNNUMBERED = 0


class Repeater:
    """Repeats the newest request at 10 Hz until the robot is seen to have acted on it.

    A request supersedes the one before it, acknowledged or not: its number is higher, and the
    robot acts on rising numbers only. Numbers go on from what the robot shows, so that a restarted
    cloud counts on where its predecessor stopped; until the robot is in sight nothing is sent.
    """

    def __init__(self) -> None:
        self._seen: Seen | None = None
        self._pending: OperatorRequest | None = None
        self._number = UNNUMBERED
        self._asked_epoch = 0
        self._due_ns = 0

    @property
    def settled(self) -> bool:
        """Whether nothing waits to be acted on."""
        return self._pending is None

    def ask(self, request: Request, start: Start = Start.SPAWN) -> None:
        """Begin to repeat a new request; `start` matters for Request.START only."""
        self._pending = OperatorRequest(UNNUMBERED, request, start)

    def see(self, seen: Seen) -> bool:
        """Take note of what is seen.

        Returns:
            True once for a request: when it is seen to have been acted on.
        """
        self._seen = seen
        acknowledged = self._is_acknowledged(seen)
        if acknowledged:
            self._pending = None
        return acknowledged

    def due(self, now_ns: int) -> OperatorRequest | None:
        """Return the request if a copy of it has to leave at `now_ns` [ns]."""
        pending, seen = self._pending, self._seen
        if pending is None or seen is None:
            return None
        if pending.number == UNNUMBERED:
            self._number = max(self._number, seen.mission) + 1
            pending = self._pending = pending._replace(number=self._number)
            self._asked_epoch = seen.epoch
        elif now_ns < self._due_ns:
            return None
        self._due_ns = now_ns + REPEAT_NS
        return pending

    def _is_acknowledged(self, seen: Seen) -> bool:
        pending = self._pending
        if pending is None or pending.number == UNNUMBERED or seen.mission != pending.number:
            return False
        if pending.request is Request.START and pending.start is Start.SPAWN:
            # Until the epoch changes it is the old world that is seen.
            return seen.epoch != self._asked_epoch
        return True
