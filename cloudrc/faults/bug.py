"""An honest cloud whose controller has a bug: now and then a command holds impossible numbers."""

from __future__ import annotations

from math import inf, nan

from cloudrc.faults.liar import Lie
from cloudrc.faults.mortal import Clock
from cloudrc.faults.scenario import generator
from cloudrc.faults.schedule import Event, Schedule
from cloudrc.faults.toll import Generator
from cloudrc.messages import Command
from cloudrc.records import Control

BUGS = ("values_invalid", "values_huge")
"""Kinds of faults that are one."""
IMPOSSIBLE = (nan, inf, -inf)
HUGE = (1e308, -1e308)


def buggy(schedule: Schedule, clock: Clock) -> Lie:
    """Make what a schedule's bugs turn commands into: one in each 1/value [s] of their whiles.

    Args:
        schedule: With the bugs.
        clock: Of cloud, which the stamps of commands are read on.
    """
    rng = generator(schedule.seed, 43)
    events = schedule.of(*BUGS)
    due = [event.at for event in events]

    def lie(command: Command, control: Control) -> Command:
        now = clock.when(control.stamp_ns) * 1e-9
        for n, event in enumerate(events):
            if due[n] <= now < event.end:
                due[n] = now + 1.0 / max(event.value, 1e-3)
                command = _ruined(command, event, rng)
        return command

    return lie


def _ruined(command: Command, event: Event, rng: Generator) -> Command:
    """One of the four numbers is not finite, or the velocity is huge."""
    if event.kind == "values_huge":
        x, y, z = (HUGE[n] for n in rng.integers(0, len(HUGE), 3).tolist())
        return command._replace(velocity=(x, y, z))
    numbers = [*command.velocity, command.yaw_rate]
    numbers[int(rng.integers(4))] = IMPOSSIBLE[int(rng.integers(len(IMPOSSIBLE)))]
    x, y, z, yaw_rate = numbers
    return command._replace(velocity=(x, y, z), yaw_rate=yaw_rate)
