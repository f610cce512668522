"""Requests over a lossy link: what to ask of the robot comes in, repeated requests go out."""

from __future__ import annotations

from cloudrc.messages import GuardState, OperatorRequest, Request, Start
from cloudrc.teleop.wire import Seen

REPEAT_NS = 100_000_000
"""Time between two copies of a request [ns]."""
UNNUMBERED = 0
NOT_ENDED = (-1, 0)
IDLE_NS = 3_000_000_000
"""A robot that was told to start, and holds or stands for so long though it is heard, has been told
something else by somebody else: it is told again."""
PREDECESSORS = 1_000
"""So many numbers are left to a process before this one: it may have asked what the robot does not
show yet, and a request of this one must not be taken for that. It may even have asked nothing else,
and begun as this one does: so the first number rises with the machine's clock, too."""
CLOCK_MAX = 65_536
"""By so much at most: numbers have to last for all processes of a session."""


class Repeater:
    """Repeats the newest request at 10 Hz until the robot is seen to have acted on it.

    A request supersedes the one before it, acknowledged or not: its number is higher, and the
    robot acts on rising numbers only; but an emergency stop is superseded by nothing. Numbers go on
    from what the robot shows, well above what a predecessor may have asked; until the robot is in
    sight nothing is sent. Every copy names the session in which it was seen last.

    When nothing is asked, the robot is told how far the mission is until it shows that it knows.
    """

    def __init__(self) -> None:
        self._seen: Seen | None = None
        self._pending: OperatorRequest | None = None
        self._afterwards: OperatorRequest | None = None
        self._progress = OperatorRequest(UNNUMBERED, Request.PROGRESS)
        self._number = UNNUMBERED
        self._asked_epoch = 0
        self._ended = NOT_ENDED  # epoch and number of the end that is acted on; no start since
        self._stands = False  # a start was acted on, and nothing has been asked since
        self._flies_ns = 0
        self._due_ns = 0

    @property
    def settled(self) -> bool:
        """Whether nothing waits to be acted on."""
        return self._pending is None

    @property
    def stopping(self) -> bool:
        """Whether the robot has not been seen yet to act on an emergency stop."""
        return self._pending is not None and self._pending.request is Request.ESTOP

    @property
    def waits(self) -> bool:
        """Whether the robot is seen to fly on no command: on the ground, or told of the end."""
        seen = self._seen
        if seen is None or self._afterwards is not None:
            return False
        return seen.guard is GuardState.GROUND or (seen.epoch, seen.mission) == self._ended

    def ask(self, request: Request, start: Start = Start.SPAWN, *, after: bool = False) -> None:
        """Begin to repeat a new request.

        Args:
            request: What is asked.
            start: Matters for Request.START only.
            after: Whether to wait until the robot has acted on what was asked before.
        """
        asked = self._progress._replace(request=request, start=start)
        self._stands = False
        if self._pending is not None and self._pending.request is Request.START:
            self._ended = NOT_ENDED  # it may have been acted on
        if self._pending is not None and (after or self.stopping):
            if self._pending.request is not request:
                self._afterwards = asked
            elif not after:
                self._afterwards = None
        else:
            self._pending, self._afterwards = asked, None

    def forget(self) -> None:
        """Ask nothing any more, for the robot flies for somebody else; but stop it all the same."""
        self._stands = False
        if not self.stopping:
            self._pending = self._afterwards = None

    def withdraw_stop(self) -> None:
        """The robot that was to be stopped flies something else by now, or is another one."""
        if self.stopping:
            self._pending, self._afterwards = self._afterwards, None

    def report(self, mission_id: int, reached: int) -> None:
        """Tell the robot from now on how many waypoints of a mission are reached; 0: no mission."""
        self._progress = self._progress._replace(mission_id=mission_id, reached=reached)
        if self._pending is None:
            self._due_ns = 0

    def see(self, seen: Seen, now_ns: int) -> Request | None:
        """Take note of what is seen at `now_ns` [ns].

        Returns:
            What was asked, once: when it is seen to have been acted on.
        """
        self._seen, pending = seen, self._pending
        if pending is None:
            self._stand_by_start(seen, now_ns)
            return None
        self._flies_ns = now_ns
        if not self._is_acknowledged(pending, seen):
            return None
        self._pending, self._afterwards = self._afterwards, None
        self._stands = pending.request is Request.START and self._pending is None
        if pending.request is Request.START:
            self._ended = NOT_ENDED
        elif pending.request is not Request.ACKNOWLEDGE:  # which ends nothing
            self._ended = seen.epoch, seen.mission
        return pending.request

    def _stand_by_start(self, seen: Seen, now_ns: int) -> None:
        """What a predecessor or another cloud has said has passed our start by: say it again."""
        ours = self._stands and seen.mission_id == self._progress.mission_id
        if not ours or seen.guard not in (GuardState.GROUND, GuardState.HOLD):
            self._flies_ns = now_ns
        if ours and seen.guard <= GuardState.HOLD:
            if 0 < self._number < seen.mission or now_ns - self._flies_ns >= IDLE_NS:
                self.ask(Request.START, Start.HERE)

    def due(self, now_ns: int) -> OperatorRequest | None:
        """Return the request if a copy of it has to leave at `now_ns` [ns]."""
        pending, seen = self._pending, self._seen
        if seen is None:
            return None
        if pending is None:
            return self._progress_due(seen, now_ns)
        # A higher number than ours was acted on: an emergency stop has passed us by. Or our very
        # number, by a predecessor: ours would be seen by now.
        if pending.number == UNNUMBERED or seen.mission >= pending.number:
            rise = 1 if self._number else PREDECESSORS + now_ns // REPEAT_NS % CLOCK_MAX
            self._number = max(self._number, seen.mission) + rise
            pending = self._pending = pending._replace(number=self._number)
            self._asked_epoch = seen.epoch
        elif now_ns < self._due_ns:
            return None
        self._due_ns = now_ns + REPEAT_NS
        return pending._replace(epoch=seen.epoch)

    def _progress_due(self, seen: Seen, now_ns: int) -> OperatorRequest | None:
        """The mission's progress, if the robot flies this very mission and does not know."""
        told = self._progress
        unknown = seen.mission_id == told.mission_id != 0 and seen.reached < told.reached
        if not unknown or now_ns < self._due_ns:
            return None
        self._due_ns = now_ns + REPEAT_NS
        return told._replace(epoch=seen.epoch)

    def _is_acknowledged(self, pending: OperatorRequest, seen: Seen) -> bool:
        if pending.number == UNNUMBERED or seen.mission != pending.number:
            return False
        if pending.request is Request.ESTOP:  # of nothing else is its number enough
            return seen.guard is GuardState.ESTOP
        if pending.request is Request.START and pending.start is Start.SPAWN:
            # Until the epoch changes it is the old world that is seen.
            return seen.epoch != self._asked_epoch
        return True
