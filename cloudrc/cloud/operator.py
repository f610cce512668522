# SPDX-License-Identifier: Apache-2.0

"""Connect cloud to teleop by messages; repeat an emergency stop until the robot has stopped."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Protocol

from cloudrc.teleop.wire import Output, RobotStatus
from cloudrc.wire.messages import (
    NEVER_NS,
    GuardState,
    OperatorRequest,
    Request,
    Setpoint,
    Telemetry,
)
from cloudrc.wire.records import Control, Fault
from cloudrc.wire.tunnel.session import NO_EPOCH

REPEAT_NS = 10_000_000
"""Time between two copies of an emergency stop [ns]. It is short, so that a link with losses delays
the stop by some 10 ms only."""
ESTOP = GuardState.ESTOP  # looking up a member of an enum is slow
_new = tuple.__new__  # makes a named tuple twice as fast as its class does


class Operator(Protocol):
    """Cloud's view of teleop, which runs in this process or behind a socket in another process."""

    @property
    def outputs(self) -> Sequence[Output | Fault]:
        """Messages from teleop since the last call of `take_outputs`."""

    def see(self, seen: RobotStatus, now_ns: int) -> None:
        """Pass the newest telemetry, received at `now_ns` [ns], to teleop."""

    def handle_deadline(self, now_ns: int) -> None:
        """Let teleop do what is due at `now_ns` [ns], cloud's clock."""

    def take_outputs(self) -> Sequence[Output | Fault]:
        """Return and remove the messages from teleop since the last call."""


def is_for_session(epoch: int, output: Output | Fault) -> bool:
    """Return whether a message from teleop is valid in the session with this epoch.

    Setpoints and START requests make the robot fly. They are valid only in the session for which
    teleop made them: before the next session another cloud may have moved the robot. Teleop sends
    both again. All other messages are valid in every session.
    """
    if isinstance(output, Setpoint) or (
        isinstance(output, OperatorRequest) and output.request is Request.START
    ):
        return output.epoch in (NO_EPOCH, epoch)
    return True


def make_robot_status(
    telemetry: Telemetry, epoch: int, world: str, delay: float, control: Control | None
) -> RobotStatus:
    """Make the status message for teleop from new telemetry.

    `world` identifies world's process. `control` is the last command of the session; it is older
    than `telemetry`. `delay` is the uplink delay of the previous telemetry [s], NaN if unknown.
    """
    # fmt: off
    stamp_ns, odometry, sensors, echo_ns, hold_ns, slip_ns, mission, guard, *rest = telemetry
    _, position, orientation, velocity, _ = odometry
    obstacles, touch, mission_id, reached, cause = rest
    age_ns = NEVER_NS if echo_ns == NEVER_NS else hold_ns
    return _new(RobotStatus, (
        epoch, position, guard, mission, world, obstacles, touch, slip_ns, mission_id, reached,
        cause, stamp_ns, orientation, velocity, age_ns, delay, control, sensors,
    ))
    # fmt: on


class EmergencyStopRepeater:
    """Repeats an emergency stop until telemetry shows that the robot has obeyed.

    Further requests for a stop in this time change nothing. Without a session, the stop waits.

    Attributes:
        sounds: Whether the stop is being repeated.
    """

    def __init__(self) -> None:
        self.sounds = self._stopped = False
        self.restart_numbers()

    def sound(self) -> None:
        """Begin to send the emergency stop repeatedly."""
        if not self.sounds:
            self.sounds, self._number, self._due_ns = True, 0, 0

    def restart_numbers(self) -> None:
        """Forget the numbers of requests, because each session numbers its requests anew."""
        self._number = self._acted_on = self._due_ns = 0

    def see(self, guard: GuardState, acted_on: int) -> None:
        """Process the guard's state and the number of the last request that world carried out."""
        self._acted_on, self._stopped = acted_on, guard is ESTOP
        if self._stopped and 0 < self._number <= acted_on:
            self.sounds = False

    def acknowledge(self) -> None:
        """Process the operator's acknowledgement: if the robot has stopped, end the repetition."""
        self.sounds = self.sounds and not self._stopped

    def due(self, asked: int, now_ns: int) -> OperatorRequest | None:
        """Return the emergency stop if cloud has to send it at `now_ns` [ns], else None.

        World carries out a request only if its number is higher than the last number. `asked` is
        the highest number of a request in this session so far; the stop gets a higher number.
        """
        if not self.sounds or now_ns < self._due_ns:
            return None
        self._due_ns = now_ns + REPEAT_NS
        if self._number <= max(self._acted_on, asked - 1):
            self._number = max(self._acted_on, asked) + 1
        return OperatorRequest(self._number, Request.ESTOP)
