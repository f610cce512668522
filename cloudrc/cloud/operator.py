"""What cloud's end knows of teleoperation: messages go to it and come from it, nothing else."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Protocol

from cloudrc.cloud.teleop.messages import Outcome, Output, Seen
from cloudrc.records import Fault


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
