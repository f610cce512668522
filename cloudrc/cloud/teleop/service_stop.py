"""The operator's emergency stop over the lives of teleop: it is asked for until it is acknowledged.

That a mission was stopped stands in the book, and so does the acknowledgement once the robot is
seen to have acted on it. A teleop that finds the one without the other asks again, for the robot
may not have heard of it; unless that robot has flown something else since, or is another one.
"""

from __future__ import annotations

from cloudrc.cloud.teleop.messages import Acknowledge, EmergencyStop, Seen
from cloudrc.cloud.teleop.mission import Teleop
from cloudrc.cloud.teleop.service_book import MissionBook
from cloudrc.cloud.teleop.service_mission import Mission


class Stop:
    """Asks for it, and knows what it has stopped."""

    def __init__(self, book: MissionBook, teleop: Teleop) -> None:
        """Ask again for what a teleop before this one has asked for."""
        self._book, self._teleop = book, teleop
        self._is_released = False
        self._is_inherited = book.stopped() is not None  # and nobody has asked this process
        if self._is_inherited:
            teleop.operate(EmergencyStop(), 0)

    @property
    def is_asked(self) -> bool:
        """Whether the robot has not been seen to have stopped yet."""
        return self._teleop.requests.stopping

    def ask(self, now_ns: int) -> None:
        """Stop the rotors at once."""
        self._is_released = self._is_inherited = False
        self._teleop.operate(EmergencyStop(), now_ns)

    def release(self, now_ns: int) -> None:
        """The operator acknowledges it; the robot is told once it has stopped."""
        self._teleop.operate(Acknowledge(), now_ns)
        self._is_released = True

    def meet(self, seen: Seen) -> None:
        """Take the first look at the robot, before teleop does."""
        stopped = self._book.stopped()
        if self._is_inherited and stopped is not None and seen.mission_id != stopped.number:
            self._teleop.requests.withdraw_stop()

    def released(self) -> Mission | None:
        """Give the mission whose stop the robot is seen to be released from, once."""
        if not self._is_released or not self._teleop.settled:
            return None
        self._is_released = False
        return self._book.stopped()
