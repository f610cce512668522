"""Which of the sent commands the robot follows, and from when on.

World follows the newest command that has arrived. Its echo shows which command this is, and since
when. A command that no echo has shown yet begins at its expected time:

    beginning on world's clock = stamp on cloud's clock + shift

The clocks need no synchronisation, because the echoes give the shift with the offset of the clocks.
"""

from __future__ import annotations

from bisect import bisect_right
from collections import deque
from collections.abc import Iterator
from typing import TypeAlias

from cloudrc.cloud.predictors import rotate_ahead
from cloudrc.messages import PLAN_STEP_NS, ZERO, Command, Odometry, Vector

PERIOD_NS = 10_000_000
"""Time between two commands [ns]. Source: docs/reference/plant.md, "Commands"."""
COUNT = 2048
"""Smallest number of commands that are remembered: 20 s, twice the longest horizon."""
GAIN = 0.05
"""Weight of a command that lasts one period in the mean shift."""
NO_COMMAND = Command(0, 0, 0, ZERO, 0.0)
Segment: TypeAlias = tuple[Vector, float]
"""A velocity command [m/s], and how long the robot follows it [s]."""


class History:
    """The commands of a session.

    Attributes:
        stamps: Stamps of the sent commands [ns], cloud's clock, rising.
        commands: The commands.
    """

    def __init__(self) -> None:
        self.stamps: list[int] = []
        self.commands: list[Command] = []
        self._applied: deque[tuple[int, int]] = deque(maxlen=COUNT)  # beginning, stamp
        self._shift_ns = 0.0

    def add(self, command: Command) -> bool:
        """Remember a command that cloud has just sent; return False if it is not the newest."""
        stamps, commands = self.stamps, self.commands
        if stamps and command.stamp_ns <= stamps[-1]:
            return False
        stamps.append(command.stamp_ns)
        commands.append(command)
        if len(stamps) == 2 * COUNT:
            del stamps[:COUNT], commands[:COUNT]
        return True

    def note_applied(self, command_stamp_ns: int, applied_ns: int) -> None:
        """Note when world applied a command, as `Predictor.applied` gets it."""
        applied = self._applied
        if not applied:
            self._shift_ns = applied_ns - command_stamp_ns
        else:
            began_ns, stamp_ns = applied[-1]
            held_ns = applied_ns - began_ns
            if held_ns <= 0 or command_stamp_ns <= stamp_ns:
                return  # from late telemetry
            # With this shift a command has the true mean age: one that loses its successors is
            # in force for longer than a period.
            shift_ns = began_ns - stamp_ns + 0.5 * (held_ns - PERIOD_NS)
            self._shift_ns += min(1.0, GAIN * held_ns / PERIOD_NS) * (shift_ns - self._shift_ns)
        applied.append((applied_ns, command_stamp_ns))

    def shift_ns(self, odometry: Odometry, horizon: float) -> int:
        """Return the shift [ns]; before the first echo, the one that `horizon` [s] implies.

        A plan begins at its own time, however late it arrives.
        """
        if self.commands and self.commands[-1].plan:
            return self.commands[-1].planned_ns - self.stamps[-1]
        if self._applied or not self.stamps:
            return round(self._shift_ns)
        return odometry.stamp_ns + round(horizon * 1e9) - self.stamps[-1] - PERIOD_NS

    def past(self, start_ns: int, end_ns: int) -> Iterator[Segment]:
        """Yield the commands that the robot followed from `start_ns` to `end_ns`, by the echoes.

        Both are on world's clock [ns]. Yield nothing before the first echo.
        """
        parts = list[Segment]()
        for began_ns, stamp_ns in reversed(self._applied):
            begin_ns = max(began_ns, start_ns)
            if begin_ns < end_ns:
                parts += reversed(played(self._command(stamp_ns), begin_ns, end_ns))
                end_ns = begin_ns
            if began_ns <= start_ns:
                break
        return reversed(parts)

    def ahead(self, start_ns: int, end_ns: int, shift_ns: int) -> Iterator[Segment]:
        """Yield the commands that the robot is expected to follow from `start_ns` to `end_ns`.

        Both are on world's clock [ns], and `start_ns` is the stamp of the newest telemetry.
        """
        stamps, commands = self.stamps, self.commands
        if not stamps:
            yield ZERO, (end_ns - start_ns) * 1e-9
            return
        newest_ns = self._applied[-1][1] if self._applied else 0
        index = max(bisect_right(stamps, max(start_ns - shift_ns, newest_ns)), 1)
        while start_ns < end_ns:
            until_ns = stamps[index] + shift_ns if index < len(stamps) else end_ns
            until_ns = min(until_ns, end_ns)
            if until_ns > start_ns:
                yield from played(commands[index - 1], start_ns, until_ns)
                start_ns = until_ns
            index += 1

    def _command(self, stamp_ns: int) -> Command:
        index = bisect_right(self.stamps, stamp_ns)
        return self.commands[index - 1] if index else NO_COMMAND


def played(command: Command, start_ns: int, end_ns: int) -> list[Segment]:
    """List the velocities of a command, with its plan, from `start_ns` to `end_ns` [ns].

    Both are on world's clock.
    """
    if not command.plan:
        return [(command.velocity, (end_ns - start_ns) * 1e-9)]
    parts = list[Segment]()
    while start_ns < end_ns:
        until_ns = start_ns + PLAN_STEP_NS - (start_ns - command.planned_ns) % PLAN_STEP_NS
        until_ns = min(until_ns, end_ns)
        parts.append((command.velocity_at(start_ns), (until_ns - start_ns) * 1e-9))
        start_ns = until_ns
    return parts


def moved(basis: Odometry, horizon: float, position: Vector, velocity: Vector) -> Odometry:
    """Return `basis` as it is after `horizon` [s], at a position [m] and a velocity [m/s]."""
    rate = basis.angular_velocity_body
    orientation = rotate_ahead(basis.orientation_wxyz, rate, horizon)
    stamp_ns = basis.stamp_ns + round(horizon * 1e9)
    return Odometry(stamp_ns, position, orientation, velocity, rate)


def limit_speed(velocity: Vector, speed_max: float) -> Vector:
    """Shorten a velocity to `speed_max` [m/s], as the guard does."""
    x, y, z = velocity
    square = x * x + y * y + z * z
    if square <= speed_max * speed_max:
        return velocity
    scale = speed_max / square**0.5
    return (x * scale, y * scale, z * scale)


def approach(reference: Vector, wanted: Vector, change_max: float) -> Vector:
    """Change a velocity by at most `change_max` [m/s] towards `wanted`, as the guard does."""
    (ax, ay, az), (bx, by, bz) = reference, wanted
    x, y, z = bx - ax, by - ay, bz - az
    square = x * x + y * y + z * z
    if square <= change_max * change_max:
        return wanted
    share = change_max / square**0.5
    return (ax + share * x, ay + share * y, az + share * z)
