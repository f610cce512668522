# SPDX-License-Identifier: Apache-2.0

"""Base class of the predictors that replay the sent commands through a model of the robot.

World follows the newest command that has arrived. On world's clock, a command begins at its stamp
plus a shift. The shift is the downlink delay plus the clock offset. It follows from telemetry,
which tells when world applied a command.
"""

from __future__ import annotations

from bisect import bisect_right
from collections import deque
from collections.abc import Iterator
from copy import copy

from cloudrc.cloud.motion import Body
from cloudrc.cloud.predictors import Model, Predictor, moved
from cloudrc.wire.messages import NEVER_NS, PLAN_STEP_NS, ZERO, Command, Odometry, Vector

PERIOD_NS = 10_000_000
"""Usual time between two samples or commands [ns]. Source: docs/reference/plant.md, "Commands"."""
COUNT = 2048
"""Smallest number of stored commands: 20 s at 100 Hz, twice the longest horizon."""
GAIN = 0.05
"""Weight in the mean shift of a command that the robot follows for PERIOD_NS [1]."""
SILENCE_NS = 200_000_000
"""Time without a new command after which the mean shift starts again [ns]."""
FOLLOWED_NS = 1_000_000_000
"""Longest time for which the robot follows a command or its plan without a newer command [ns]."""
NO_COMMAND = Command(0, 0, 0, ZERO, 0.0)


class Replay(Predictor):
    """Base of the predictors that feed the sent commands to a model of the robot.

    Attributes:
        commands: Those of the session, oldest first.
        stamps: Theirs [ns], cloud's clock.
        newest: The newest odometry sample.
        is_foreign: Whether the model is that of a user's file.
    """

    is_foreign = False

    def __init__(self) -> None:
        self.reset()

    def reset(self) -> None:
        """Forget all samples, commands and echoes."""
        self.stamps: list[int] = []
        self.commands: list[Command] = []
        self.newest: Odometry | None = None
        self._applied: deque[tuple[int, int]] = deque(maxlen=COUNT)  # beginning and stamp [ns]
        self._shift_ns = 0.0
        self._last: Body | None = None

    def commanded(self, command: Command) -> None:
        """Store a sent command, unless it is not newer than the last one."""
        if self.stamps and command.stamp_ns <= self.stamps[-1]:
            return
        self.stamps.append(command.stamp_ns)
        self.commands.append(command)
        if len(self.stamps) == 2 * COUNT:
            del self.stamps[:COUNT], self.commands[:COUNT]

    @property
    def _period_ns(self) -> int:
        return self.stamps[-1] - self.stamps[-2] if len(self.stamps) > 1 else PERIOD_NS

    def applied(self, command_stamp_ns: int, applied_ns: int) -> None:
        """Update the mean shift: the mean time from a command's stamp to its application.

        World applied the command with the stamp `command_stamp_ns` (cloud's clock) at `applied_ns`
        (world's clock), both [ns].
        """
        stamp_ns, began_ns = command_stamp_ns, applied_ns
        last_began_ns, last_stamp_ns = self._applied[-1] if self._applied else (NEVER_NS, 0)
        lasted_ns = began_ns - last_began_ns
        if lasted_ns <= 0:
            return  # from late telemetry
        # The echoes of other commands since the newest odometry may be late or lost.
        seen_ns = self.newest.stamp_ns if self.newest else NEVER_NS
        lasted_ns = min(lasted_ns, max(seen_ns - last_began_ns, 0) + self._period_ns)
        if not self._applied or lasted_ns > SILENCE_NS:
            self._shift_ns = began_ns - stamp_ns
        else:
            # A command lasts longer if the next ones are lost. Half of the extra time counts.
            shift_ns = last_began_ns - last_stamp_ns + 0.5 * (lasted_ns - self._period_ns)
            share = min(1.0, GAIN * lasted_ns / PERIOD_NS)
            self._shift_ns += share * (shift_ns - self._shift_ns)
        self._applied.append((began_ns, stamp_ns))

    def is_silent(self, now_ns: int) -> bool:
        """Return whether the robot follows no command at `now_ns` [ns], world's clock.

        It follows none if world applied the last echoed command over FOLLOWED_NS before `now_ns`.
        """
        return bool(self._applied) and now_ns - self._applied[-1][0] > FOLLOWED_NS

    def shift_ns(self, odometry: Odometry, horizon: float) -> int:
        """Return the shift [ns]: the time from a command's stamp until world begins to follow it.

        If the newest command has a plan, the shift ends when the plan begins. Otherwise the echoes
        show the shift. Before the first echo, the shift comes from the newest `odometry` and the
        `horizon` [s].
        """
        if self.commands and self.commands[-1].plan:
            return self.commands[-1].planned_ns - self.stamps[-1]
        if self._applied or not self.stamps:
            return round(self._shift_ns)
        return odometry.stamp_ns + round(horizon * 1e9) - self.stamps[-1] - self._period_ns

    def past(self, start_ns: int, end_ns: int) -> Iterator[tuple[Vector, float]]:
        """Yield velocity [m/s] and duration [s] of each command that world has followed.

        The commands are those from `start_ns` to `end_ns` [ns], world's clock. The echoes show when
        each of them began.
        """
        parts = list[tuple[Vector, float]]()
        for began_ns, stamp_ns in reversed(self._applied):
            if began_ns < end_ns:
                index = bisect_right(self.stamps, stamp_ns)
                followed = self.followed(index, max(began_ns, start_ns), end_ns)
                parts += reversed(followed)
                end_ns = began_ns
            if began_ns <= start_ns:
                break
        return reversed(parts)

    def ahead(self, start_ns: int, end_ns: int, shift_ns: int) -> list[tuple[Vector, float]]:
        """Predict which commands world follows from `start_ns` to `end_ns`, world's clock [ns].

        List velocity [m/s] and duration [s] of each command. World begins to follow a command at
        the command's stamp plus `shift_ns` [ns].
        """
        stamps, commands, parts = self.stamps, self.commands, list[tuple[Vector, float]]()
        index = bisect_right(stamps, start_ns - shift_ns)
        while start_ns < end_ns:
            until_ns = stamps[index] + shift_ns if index < len(stamps) else end_ns
            if until_ns > end_ns:
                until_ns = end_ns
            if index and not commands[index - 1].plan:  # as `followed` does, without its call
                parts.append((commands[index - 1].velocity, (until_ns - start_ns) * 1e-9))
            else:
                parts += self.followed(index, start_ns, until_ns)
            start_ns, index = until_ns, index + 1
        return parts

    def followed(self, count: int, start_ns: int, end_ns: int) -> list[tuple[Vector, float]]:
        """List the velocities [m/s] of one command, and for how long world follows each [s].

        World follows the command from `start_ns` to `end_ns`, world's clock [ns]. A command with a
        plan has one velocity per step of the plan. `count` = n selects the n-th of `commands`; with
        `count` = 0, there is no command yet, and the velocity is zero.
        """
        command = self.commands[count - 1] if count else NO_COMMAND
        if not command.plan:
            return [(command.velocity, (end_ns - start_ns) * 1e-9)]
        parts, planned_ns = list[tuple[Vector, float]](), command.planned_ns
        while start_ns < end_ns:
            until_ns = start_ns + PLAN_STEP_NS - (start_ns - planned_ns) % PLAN_STEP_NS
            if until_ns > end_ns:
                until_ns = end_ns
            parts.append((command.velocity_at(start_ns), (until_ns - start_ns) * 1e-9))
            start_ns = until_ns
        return parts

    def observe(self, odometry: Odometry, forecast: Body | None = None) -> None:
        """Store the newest odometry sample; `forecast` is that for its stamp, if it is known."""
        self.newest = odometry

    def roll(self, odometry: Odometry, horizon: float) -> Body:
        """Return a model of the robot in the state `horizon` [s] after `odometry`."""
        raise NotImplementedError

    def forecast(self, stamp_ns: int) -> Body | None:
        """Predict from the newest sample; return the model in its state at `stamp_ns` [ns].

        Return None if there is no sample, or if the newest sample is not older than `stamp_ns`.
        """
        if self.newest is None or stamp_ns <= self.newest.stamp_ns:
            return None
        return self.roll(self.newest, (stamp_ns - self.newest.stamp_ns) * 1e-9)

    def predict(self, odometry: Odometry, horizon: float) -> Odometry:
        """Predict, by the sent commands, the odometry `horizon` [s] after the sample `odometry`."""
        self._last = body = self.roll(odometry, horizon)
        if not horizon:
            return odometry
        return moved(body.basis, body.horizon, body.position, body.velocity)

    def model(self) -> Model | None:
        """Return a copy of the model in the state of the last prediction; None before the first."""
        return copy(self._last)
