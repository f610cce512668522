"""What cloud's end knows of teleoperation: messages go to it and come from it, nothing else.

One of them it has to see through by itself: the alarm.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Protocol

from cloudrc.messages import GuardState, OperatorRequest, Request, Setpoint, Telemetry
from cloudrc.records import Fault
from cloudrc.teleop.wire import Outcome, Output, Seen
from cloudrc.tunnel.session import NO_EPOCH

REPEAT_NS = 100_000_000
"""Time between two copies of the alarm [ns]."""
_new = tuple.__new__  # of a named tuple: the constructor of its class takes twice the time


class Operator(Protocol):
    """Teleop as cloud knows it: the machine itself, or the socket behind which it lives."""

    @property
    def outputs(self) -> Sequence[Output | Fault]:
        """What it has said since the last call of `take_outputs`."""

    @property
    def outcome(self) -> Outcome | None:
        """How the mission ended; None while there is none, or cloud has to go on anyway."""

    @property
    def settled(self) -> bool:
        """Whether the robot is seen to have acted on the last request."""

    def see(self, seen: Seen, now_ns: int) -> None:
        """Take note of the newest telemetry."""

    def handle_deadline(self, now_ns: int) -> None:
        """Do what is due."""

    def take_outputs(self) -> Sequence[Output | Fault]:
        """Hand over what it has said since the last call."""


def is_meant_for(epoch: int, said: Output | Fault) -> bool:
    """Whether what teleop says may lead the robot in a session.

    Where to fly, and to start, is meant for one session: teleop may lag, and somebody else may have
    moved the robot since; it says it again. All else passes whenever it was said. An end and a stop
    lead nowhere, progress is of the mission that it names, and an acknowledgement arms nothing.

    Args:
        epoch: Of the session.
        said: What is to be obeyed in it.
    """
    if isinstance(said, Setpoint) or (
        isinstance(said, OperatorRequest) and said.request is Request.START
    ):
        return said.epoch in (NO_EPOCH, epoch)
    return True


def seen_in(
    telemetry: Telemetry, epoch: int, world: str, delays: tuple[float, float, float]
) -> Seen:
    """Make what teleop is told of telemetry.

    Args:
        telemetry: The newest.
        epoch: Session that it belongs to.
        world: Names world's process.
        delays: Horizon, round trip and loop delay of the last command [s]; NaN before the first.
    """
    known = (
        epoch,
        telemetry.odometry.position,
        telemetry.guard,
        telemetry.mission,
        world,
        telemetry.pipe_contacts,
        telemetry.touch_speed,
        telemetry.slip_ns,
        *delays,
        telemetry.mission_id,
        telemetry.reached,
        telemetry.cause,
    )
    return _new(Seen, known)


class Alarm:
    """An emergency stop that has passed teleop by: told to the robot until it is seen to stand.

    Teleop's own machine may hang in its disk, so nobody else repeats it. It waits for a session,
    and outlives one.

    Attributes:
        sounds: Whether the robot is not seen yet to stand.
    """

    def __init__(self) -> None:
        self.sounds = False
        self._number = self._acted_on = self._due_ns = 0

    def sound(self) -> None:
        """Begin, or go on."""
        if not self.sounds:
            self.sounds, self._number, self._due_ns = True, 0, 0

    def begin_again(self) -> None:
        """In another session numbers may begin again."""
        self._number = self._acted_on = self._due_ns = 0

    def see(self, guard: GuardState, acted_on: int) -> None:
        """Take note of the guard's state, and of the last request that world has acted on."""
        self._acted_on = acted_on
        if guard is GuardState.ESTOP:
            self.sounds = False

    def due(self, asked: int, now_ns: int) -> OperatorRequest | None:
        """Give the request, if a copy of it has to leave.

        World acts on rising numbers only: what has reached it before the alarm takes its number.

        Args:
            asked: The highest number of a request so far.
            now_ns: Now [ns].
        """
        if not self.sounds or now_ns < self._due_ns:
            return None
        self._due_ns = now_ns + REPEAT_NS
        if self._number <= max(self._acted_on, asked - 1):
            self._number = max(self._acted_on, asked) + 1
        return OperatorRequest(self._number, Request.ESTOP)
