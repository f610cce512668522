"""Collect the breaches of safety invariants in a flight; know the limits of robot and scene."""

from __future__ import annotations

from bisect import bisect_right
from collections import Counter
from math import inf
from typing import NamedTuple

from cloudrc.config.resolved import ResolvedExperiment
from cloudrc.config.robot import find_robot
from cloudrc.config.scene import scene_of
from cloudrc.geometry.obstacles import fence_of
from cloudrc.messages import GuardState
from cloudrc.records import CommandApplied, Record, SessionOpened

GROUND, TRACK, HOLD, LAND, ESTOP = GuardState
FLOWN, LATCHED = (TRACK, HOLD, LAND), (LAND, ESTOP)
"""States in which the actuators are on; states that the operator's acknowledgement ends."""
REELS_NS = 1_000_000_000  # time after a collision in which it explains the robot's motion [ns]
REPORTED = 5  # number of breaches of each kind that are kept


class Breach(NamedTuple):
    """A violation of an invariant: the invariant's name, and what happened."""

    time: float  # time on world's clock [s]
    kind: str
    text: str


class Watch:
    """Collects the breaches of invariants in a flight, and checks the order of commands.

    Attributes:
        limits: Limits of the guard.
        low: Corner of the fence [m]; a planar robot has no floor and no ceiling.
        high: Opposite corner [m].
        braking: Deceleration of the robot [m/s^2].
        planar: Whether the robot stays on the ground.
        touched: Body that the mission has to touch.
        now_ns: Time of the last step, command or request [ns], world's clock.
        breaches: The first breaches of each kind.
        counts: Number of breaches by kind.
        margin: Smallest distance of the base to the fence, without the floor [m].
        speed: Largest reference [m/s].
        starts_ns: Times at which world's processes began [ns].
    """

    def __init__(self, experiment: ResolvedExperiment) -> None:
        robot, fence = find_robot(experiment.world.robot), fence_of(scene_of(experiment.world))
        self.limits, self.touched = experiment.guard, experiment.mission.touched
        self.planar, self.braking = robot.planar, robot.guard.braking_mps2
        self.low, self.high = fence.low, fence.high
        if robot.planar:
            self.low, self.high = (*fence.low[:2], -inf), (*fence.high[:2], inf)
        self.now_ns, self.margin, self.speed = 0, 9.0, 0.0
        self.breaches, self.counts = list[Breach](), Counter[str]()
        self.starts_ns = list[int]()
        self._newest = (0, 0, -1)  # newest command: process of world, epoch and counter

    def see(self, records: list[Record], now_ns: int) -> None:
        """Check in the new `records` of world that each command was applied once and in order.

        The order of commands is that of epochs and, within an epoch, of counters. It begins anew
        with each process of world: if cloud knows no epoch, a restarted world begins at the first.
        """
        for record in records:
            if isinstance(record, CommandApplied | SessionOpened):
                counter = record.counter if isinstance(record, CommandApplied) else -1
                process = bisect_right(self.starts_ns, record.stamp_ns)
                if (this := (process, record.epoch, counter)) <= self._newest:
                    text = f"command {counter} of epoch {record.epoch} after {self._newest[1:]}"
                    self.note("order", text, record.stamp_ns)
                self._newest = max(self._newest, this)

    def note(self, kind: str, text: str, at_ns: int | None = None) -> None:
        """Record a breach of the invariant `kind`, at `at_ns` [ns] or now; `text` describes it."""
        self.counts[kind] += 1
        if self.counts[kind] <= REPORTED:
            time_ns = self.now_ns if at_ns is None else at_ns
            self.breaches.append(Breach(time_ns * 1e-9, kind, text))
