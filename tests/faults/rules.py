# SPDX-License-Identifier: Apache-2.0

"""The limits of robot and scene that invariants compare with, and the breach of an invariant."""

from __future__ import annotations

from math import inf
from typing import NamedTuple

from cloudrc.config.resolved import ResolvedExperiment
from cloudrc.physics.geometry.obstacles import fence_of
from cloudrc.wire.messages import GuardState

GROUND, TRACK, HOLD, LAND, ESTOP = GuardState
FLOWN, LATCHED = (TRACK, HOLD, LAND), (LAND, ESTOP)
"""States in which the actuators are on; states that the operator's acknowledgement ends."""


class Breach(NamedTuple):
    """A violation of an invariant: the invariant's name, and what happened."""

    time: float  # time on world's clock [s]
    kind: str
    text: str


class Rules:
    """Limits of one robot in one scene.

    Attributes:
        limits: Limits of the guard.
        low: Corner of the fence [m]; a planar robot has no floor and no ceiling.
        high: Opposite corner [m].
        braking: Deceleration of the robot [m/s^2].
        planar: Whether the robot stays on the ground.
        touched: Body that the mission has to touch.
    """

    def __init__(self, experiment: ResolvedExperiment) -> None:
        robot, fence = experiment.robot, fence_of(experiment.scene)
        self.limits, self.touched = experiment.guard, experiment.mission.touched
        self.planar, self.braking = robot.planar, robot.guard.braking_mps2
        self.low, self.high = fence.low, fence.high
        if robot.planar:
            self.low, self.high = (*fence.low[:2], -inf), (*fence.high[:2], inf)
