# SPDX-License-Identifier: Apache-2.0

"""Write the file of a new perception, which the user changes."""

from __future__ import annotations

from pathlib import Path

from cloudrc.files import write_atomically

PERCEPTION = '''\
"""Perception: goes where there is most room ahead."""

import numpy as np

from cloudrc.cloud.perceptions import Perception, Scan, point_at
from cloudrc.messages import Odometry, Setpoint


class MostRoom(Perception):
    def __init__(self, width: int, ahead: float) -> None:
        self.width, self.ahead = width, ahead

    def see(self, seen: Scan, odometry: Odometry) -> Setpoint | None:
        # seen.ranges [m] (inf: nothing within range) at seen.angles [rad], which rise to the left.
        # odometry is the robot's when the scan was taken, which is some time ago.
        ahead = np.abs(seen.angles) < np.radians(60)
        ranges, angles = np.minimum(seen.ranges[ahead], 5.0), seen.angles[ahead]
        sides = [slice(max(n - self.width, 0), n + self.width + 1) for n in range(len(ranges))]
        free = [ranges[side].min() for side in sides]
        best = int(np.argmax(free))
        return Setpoint(point_at(odometry, angles[best], min(free[best], self.ahead)))


def build(width: int = 12, ahead: float = 1.5) -> MostRoom:
    return MostRoom(width, ahead)
'''


def write_perception(file: Path) -> None:
    """Write a perception to a new `file`."""
    write_atomically(file, PERCEPTION.encode())
