"""Find the obstacles that are in the way of a robot."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from cloudrc.geometry.clearance import NO_SIZE, Spheres
from cloudrc.geometry.obstacles import obstacles, surface
from cloudrc.geometry.placement import find_crossed
from cloudrc.geometry.scene import Scene
from cloudrc.teleop.wire import Leg, RobotStatus
from cloudrc.text import describe_point


class KnownObstacles(NamedTuple):
    """The obstacles of a scene, for a robot; the body `touch` that a mission touches is none."""

    scene: Scene | None = None  # None: nothing is known about obstacles
    hull: Spheres = NO_SIZE

    def crossed(self, seen: RobotStatus, leg: Leg, touch: str | None) -> str:
        """Say which obstacle is on the straight way from the robot to a leg; "" if none is."""
        if self.scene is None:
            return ""
        here, there = np.array([seen.position]), np.array([leg.position])
        known = obstacles(self.scene, touch=touch)
        through = int(find_crossed(known, self.hull, here, there)[0])
        if through < 0:
            return ""
        return (
            f"the straight way from where the robot is, {describe_point(seen.position)}, to "
            f"{describe_point(leg.position)} leads through {surface(known[through])}; "
            "go round it first, by another target"
        )
