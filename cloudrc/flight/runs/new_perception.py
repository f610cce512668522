# SPDX-License-Identifier: Apache-2.0

"""Write the file of a new perception, which the user changes."""

from __future__ import annotations

from pathlib import Path

from cloudrc.base.files import write_atomically

PERCEPTION = '''\
"""Perception: goes where there is most room ahead."""

import numpy as np

from cloudrc.plugin import Odometry, Perception, Scan, Setpoint, point_at


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

OF_CAMERA = '''\
"""Perception: turns towards the reddest part of the picture."""

from math import atan, tan

import numpy as np

from cloudrc.plugin import Frame, Odometry, Perception, Setpoint, yaw_of


class Reddest(Perception):
    takes = "camera"

    def __init__(self, threshold: int, height: float) -> None:
        self.threshold, self.height = threshold, height

    def see(self, seen: Frame, odometry: Odometry) -> Setpoint | None:
        # seen.image: red, green, blue, shape (height, width, 3); row 0 is the highest.
        # odometry is the robot's when the picture was taken, which is some time ago.
        image = seen.image.astype(int)
        redness = image[..., 0] - image[..., 1:].max(axis=2)
        rows, columns = np.nonzero(redness > self.threshold)
        if len(columns) < 10:
            return None  # the last setpoint stays
        height, width = redness.shape
        focal = height / 2 / tan(seen.fovy / 2)  # points of the picture per tangent of the angle
        left = atan((width / 2 - columns.mean()) / focal)
        x, y, _ = odometry.position
        return Setpoint((x, y, self.height), yaw_of(odometry) + left, turns=True)


def build(threshold: int = 80, height: float = 1.5) -> Reddest:
    return Reddest(threshold, height)
'''


def write_perception(file: Path, *, camera: bool = False) -> None:
    """Write a perception to a new `file`: for scans, or for the pictures of a `camera`."""
    write_atomically(file, (OF_CAMERA if camera else PERCEPTION).encode())
