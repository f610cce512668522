# SPDX-License-Identifier: Apache-2.0

"""Perception: keeps a coloured body ahead, at a distance, and turns towards it.

All points of the picture that have the body's colour are the body: their mean is its centre, and
their height tells its distance. The robot goes to the point at `distance_m` from the body on the
line between the two, at the height of the body, and looks at it.

Source: F. Chaumette, S. Hutchinson, "Visual servo control, part I: basic approaches", IEEE Robotics
and Automation Magazine 13 (2006), 82-90, position-based control.
Deviation: the camera is taken to be at the base, and to look ahead.
"""

from __future__ import annotations

from math import atan2, cos, radians, sin, sqrt, tan
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from cloudrc.cloud.perceptions import Frame, Perception, place_of
from cloudrc.config.robot import RobotFacts
from cloudrc.config.schema import Positive
from cloudrc.wire.messages import Odometry, Setpoint, Vector

Colour = tuple[int, int, int]
POINTS_MIN = 12
"""Smallest number of points that count as the body."""
DARK = 60
"""Length of a colour below which a point has none, in the units of its three numbers."""


class Target(Perception):
    """Follows a body of one colour."""

    takes: Literal["scan", "camera"] = "camera"

    def __init__(self, colour: Colour, tolerance: float, size: float, distance: float) -> None:
        """Set colour, tolerance [rad], size [m] and distance [m]; `build` describes them."""
        self._colour, self._likeness = colour, cos(tolerance) ** 2
        self._size, self._distance = size, distance

    def see(self, seen: Frame, odometry: Odometry) -> Setpoint | None:
        """Return the point at the distance from the body, and the heading towards it."""
        rows, columns = np.nonzero(self._find(seen.image))
        if len(rows) < POINTS_MIN:
            return None
        height, width = seen.image.shape[:2]
        focal = height / 2.0 / tan(seen.fovy / 2.0)
        # The variance of n rows is (n^2 - 1) / 12. n squares cover n + 1 points.
        seen_size = (sqrt(12.0 * float(rows.var()) + 1.0) + 1.0) / focal
        ahead = self._size / seen_size
        left = (width / 2.0 - 1.0 - float(columns.mean())) / focal
        up = (height / 2.0 - 1.0 - float(rows.mean())) / focal
        return self._keep_away(place_of(odometry, (ahead, ahead * left, ahead * up)), odometry)

    def _find(self, image: NDArray[np.uint8]) -> NDArray[np.bool_]:
        """Return which squares of 2 x 2 points have the colour, whether bright or in the shade.

        A single point of the colour is noise. Shape (height - 1, width - 1).
        """
        red, green, blue = np.moveaxis(image.astype(np.int64), 2, 0)
        r, g, b = self._colour
        along = red * r + green * g + blue * b
        square = red * red + green * green + blue * blue
        alike = along * along >= self._likeness * (r * r + g * g + b * b) * square
        alike &= square >= DARK * DARK
        pairs = alike[1:] & alike[:-1]
        found: NDArray[np.bool_] = pairs[:, 1:] & pairs[:, :-1]
        return found

    def _keep_away(self, body: Vector, odometry: Odometry) -> Setpoint:
        (x, y, z), (here_x, here_y, _) = body, odometry.position
        yaw = atan2(y - here_y, x - here_x)
        position = x - self._distance * cos(yaw), y - self._distance * sin(yaw), z
        return Setpoint(position, yaw, turns=True)


def build(
    robot: RobotFacts | None = None,
    colour: Colour = (230, 26, 20),
    tolerance_deg: Positive = 15.0,
    size_m: Positive = 0.6,
    distance_m: Positive = 3.0,
) -> Target:
    """Make a perception that follows a coloured body.

    Args:
        robot: What cloud knows of the robot; None: nothing.
        colour: Red, green and blue of the body, 0 to 255; its brightness does not count.
        tolerance_deg: Largest angle between a colour and that of the body, as vectors [deg].
        size_m: Height of the body [m].
        distance_m: Distance to keep from it [m].
    """
    if robot is not None and robot.heading != "free":
        raise ValueError(
            f"the heading of {robot.name} is {robot.heading}, so it cannot turn towards the target;"
            " choose a robot whose heading is free, such as x2"
        )
    if not (any(colour) and all(0 <= each <= 255 for each in colour)):
        raise ValueError(f"colour: {[*colour]}: must be three numbers 0 to 255, one above 0")
    return Target(colour, radians(tolerance_deg), size_m, distance_m)
