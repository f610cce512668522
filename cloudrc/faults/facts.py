"""What the invariants know of a robot, its scene and its limits."""

from __future__ import annotations

from math import inf
from typing import NamedTuple

from cloudrc.config.resolved import ResolvedExperiment, ResolvedGuard
from cloudrc.config.robot import find_robot
from cloudrc.config.scene import scene_of
from cloudrc.geometry.obstacles import fence_of
from cloudrc.messages import GuardState, Vector

GROUND, TRACK, HOLD, LAND, ESTOP = GuardState
FLOWN, LATCHED = (TRACK, HOLD, LAND), (LAND, ESTOP)
"""States in which the actuators are on; states that the operator's acknowledgement ends."""
REELS_NS = 1_000_000_000  # time after a collision in which it explains the robot's motion [ns]


class Facts(NamedTuple):
    """Limits of the guard, and what the robot can do."""

    limits: ResolvedGuard
    low: Vector  # corner of the fence [m]; a planar robot has no floor and no ceiling
    high: Vector  # opposite corner [m]
    braking: float  # deceleration of the robot [m/s^2]
    planar: bool  # whether the robot stays on the ground
    touch: str | None = None  # body that the mission has to touch

    @classmethod
    def of(cls, experiment: ResolvedExperiment) -> Facts:
        """Read the facts of an experiment."""
        world = experiment.world
        robot, fence = find_robot(world.robot), fence_of(scene_of(world))
        low, high = fence.low, fence.high
        if robot.planar:
            low, high = (*low[:2], -inf), (*high[:2], inf)
        braking, touch = robot.guard.braking_mps2, experiment.mission.touched
        return cls(experiment.guard, low, high, braking, robot.planar, touch)
