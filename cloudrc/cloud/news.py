# SPDX-License-Identifier: Apache-2.0

"""Send-on-delta: tell which commands are news to the robot, so that cloud sends no others.

A robot that gets no newer command follows the plan of the last one. A command whose plan is nearly
the same changes nothing. Commands that cloud does not send look lost to the robot, so that the
guard needs no rule for them.

Source: M. Miskowicz, "Send-on-delta concept: an event-based data reporting strategy", Sensors 6
(1), 2006. Deviation: not samples of a signal are compared, but plans of the same instants.
"""

from __future__ import annotations

from cloudrc.wire.messages import PLAN_STEP_NS, Command, GuardState, plan_length

HOLD = GuardState.HOLD  # looking up a member of an enum is slow


class SendOnDelta:
    """Compares each command with the last one sent."""

    def __init__(self, delta: float, beat: float) -> None:
        """Set the largest difference of a velocity that is no news, and the time of the beat.

        `delta` is for the velocity per axis [m/s], and for the yaw rate [rad/s]. After `beat` [s]
        every command is news.
        """
        self._delta, self._beat_ns = delta, round(beat * 1e9)
        self._beat = plan_length(beat)
        self._last: Command | None = None

    def has(self, command: Command, guard: GuardState) -> bool:
        """Return whether a command is news; if so, the next ones are compared with it.

        `guard` is the state in the newest telemetry. In HOLD all commands are news: only several
        within a short time end it.
        """
        last = self._last
        if last is not None and guard is not HOLD and not self._differs(command, last):
            return False
        self._last = command
        return True

    def _differs(self, command: Command, last: Command) -> bool:
        """Return whether the beat is over, a plan is missing, or one differs where both reach."""
        most = self._delta
        if command.stamp_ns - last.stamp_ns >= self._beat_ns or not (command.plan and last.plan):
            return True
        if abs(command.yaw_rate - last.yaw_rate) > most:
            return True
        for step in range(len(command.plan) - self._beat):
            at_ns = command.planned_ns + step * PLAN_STEP_NS
            new, old = command.velocity_at(at_ns), last.velocity_at(at_ns)
            if any(abs(a - b) > most for a, b in zip(new, old, strict=True)):
                return True
        return False
