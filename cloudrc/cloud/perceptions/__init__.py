# SPDX-License-Identifier: Apache-2.0

"""Perceptions turn what the robot's sensors see into setpoints, while a mission flies.

Each perception is a plug-in in a file of its own. The file defines `build(**parameters)`, which
returns a `Perception`; all parameters are annotated.
"""

from __future__ import annotations

from math import cos, sin
from typing import NamedTuple, TypeAlias

import numpy as np
from numpy.typing import NDArray

from cloudrc.geometry.vectors import turn_to
from cloudrc.messages import Odometry, Setpoint, Vector


class Scan(NamedTuple):
    """Distances that the robot's scanner measured at one time, with its errors."""

    stamp_ns: int  # time of the measurement [ns], world's clock
    ranges: NDArray[np.float64]  # of all rays [m], shape (rays,); inf: nothing within range
    angles: NDArray[np.float64]  # of all rays [rad], shape (rays,); x ahead, rising to the left


Seen: TypeAlias = Scan
"""What a perception gets."""


def yaw_of(odometry: Odometry) -> float:
    """Return the robot's heading [rad], world frame."""
    return -turn_to(0.0, odometry.orientation_wxyz)


def point_at(odometry: Odometry, angle: float, distance: float) -> Vector:
    """Return the place [m], world frame, that the robot sees at an angle [rad] and distance [m]."""
    (x, y, z), heading = odometry.position, yaw_of(odometry) + angle
    return (x + distance * cos(heading), y + distance * sin(heading), z)


class Perception:
    """Turns scans into setpoints; a plug-in has to define `see` only.

    Attributes:
        takes: Sensor whose data `see` gets: "scan".
    """

    takes = "scan"

    def reset(self) -> None:
        """Forget everything at the start of a mission."""

    def see(self, seen: Seen, odometry: Odometry) -> Setpoint | None:
        """Return where the robot has to go, world frame; None: the last setpoint stays.

        Cloud brings the position into the fence. It flies to the setpoint as if teleop had given
        it; epoch, waypoint and motion of the result do not count.

        Args:
            seen: The newest that has arrived.
            odometry: Pose and twist as measured when `seen` was taken, or just before.
        """
        raise NotImplementedError
