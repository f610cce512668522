# SPDX-License-Identifier: Apache-2.0

"""Perception: turns towards the reddest part of the picture.

Distances are in m, angles in rad; setpoints are in the world frame.
Source: the model of a pinhole camera, tan(angle) = (column - centre) / focal length.
"""

from math import atan, tan

import numpy as np

from cloudrc.plugin import Frame, Odometry, Perception, Setpoint, yaw_of


class Reddest(Perception):
    """Looks for points that are redder than `threshold` (0 to 255); flies at `height` [m]."""

    takes = "camera"

    def __init__(self, threshold: int, height: float) -> None:
        self.threshold, self.height = threshold, height

    def see(self, seen: Frame, odometry: Odometry) -> Setpoint | None:
        """Return where to turn. `odometry` is that of the picture, which was taken some time ago.

        `seen.image` has red, green, blue, shape (height, width, 3); row 0 is the highest. None
        means that the last setpoint stays.
        """
        image = seen.image.astype(int)
        redness = image[..., 0] - image[..., 1:].max(axis=2)
        _, columns = np.nonzero(redness > self.threshold)
        if len(columns) < 10:
            return None
        height, width = redness.shape
        focal = height / 2 / tan(seen.fovy / 2)  # [points]
        left = atan((width / 2 - float(columns.mean())) / focal)
        x, y, _ = odometry.position
        return Setpoint((x, y, self.height), yaw_of(odometry) + left, turns=True)


def build(threshold: int = 80, height: float = 1.5) -> Reddest:
    """Return the perception; `threshold` [1] and `height` [m] are parameters of the experiment."""
    return Reddest(threshold, height)
