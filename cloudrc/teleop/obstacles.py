"""Find the obstacles that are in the way of a robot, or that it touches."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from cloudrc.geometry.clearance import NO_SIZE, Spheres, clearance_per_obstacle
from cloudrc.geometry.obstacles import obstacles, surface
from cloudrc.geometry.placement import find_crossed
from cloudrc.geometry.scene import Scene
from cloudrc.messages import Vector
from cloudrc.teleop.wire import Leg, RobotStatus


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
            f"the straight way from where the robot is, {_place(seen.position)}, to "
            f"{_place(leg.position)} leads through {surface(known[through])}; "
            "go round it first, by another target"
        )

    def describe_contact(self, seen: RobotStatus, touch: str | None) -> str:
        """Say where a robot that touches an obstacle is.

        Telemetry counts contacts, but does not name the bodies. The text names the nearest one.
        """
        known = obstacles(self.scene, touch=touch) if self.scene else ()
        text = f"{_place(seen.position)} m"
        if not known:
            return text
        where = [seen.position], [seen.orientation_wxyz]
        away = clearance_per_obstacle(known, *where, self.hull)[0]
        return f"{text}, next to {known[away.argmin()].name}"


def _place(position: Vector) -> str:
    return f"[{', '.join(f'{value:.2f}' for value in position)}]"
