# SPDX-License-Identifier: Apache-2.0

"""Perception: goes where there is most room ahead, by the scans of a rover.

Distances are in m, angles in rad; setpoints are in the world frame.
"""

import numpy as np

from cloudrc.plugin import Odometry, Perception, Scan, Setpoint, point_at


class MostRoom(Perception):
    """Looks for room, with `width` rays on each side; its goal is at most `ahead` [m] away."""

    def __init__(self, width: int, ahead: float) -> None:
        self.width, self.ahead = width, ahead

    def see(self, seen: Scan, odometry: Odometry) -> Setpoint | None:
        """Return where to go. `odometry` is that of the scan, which was taken some time ago.

        `seen.ranges` [m] (inf: nothing within range) are at `seen.angles` [rad], which rise to the
        left. None means that the last setpoint stays.
        """
        ahead = np.abs(seen.angles) < np.radians(60)
        ranges, angles = np.minimum(seen.ranges[ahead], 5.0), seen.angles[ahead]
        sides = [slice(max(n - self.width, 0), n + self.width + 1) for n in range(len(ranges))]
        free = [float(ranges[side].min()) for side in sides]
        best = int(np.argmax(free))
        return Setpoint(point_at(odometry, float(angles[best]), min(free[best], self.ahead)))


def build(width: int = 12, ahead: float = 1.5) -> MostRoom:
    """Return the perception; `width` [rays] and `ahead` [m] are parameters of the experiment."""
    return MostRoom(width, ahead)
