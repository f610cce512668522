# SPDX-License-Identifier: Apache-2.0

"""Perceptions turn what the robot's sensors see into setpoints, while a mission flies.

Each perception is a plug-in in a file of its own. The file defines `build(**parameters)`, which
returns a `Perception`; all parameters are annotated.
"""

from __future__ import annotations

from math import cos, sin
from typing import Any, Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from cloudrc.physics.geometry.vectors import turn_to
from cloudrc.wire.messages import Odometry, Setpoint, Vector
from cloudrc.wire.rotation import rotate


class Scan(NamedTuple):
    """Distances that the robot's scanner measured at one time, with its errors."""

    stamp_ns: int  # time of the measurement [ns], world's clock
    ranges: NDArray[np.float64]  # of all rays [m], shape (rays,); inf: nothing within range
    angles: NDArray[np.float64]  # of all rays [rad], shape (rays,); x ahead, rising to the left


class Frame(NamedTuple):
    """A picture that the robot's camera took, as its codec left it."""

    stamp_ns: int  # time at which it was taken [ns], world's clock
    number: int  # in the session, from 0 on
    image: NDArray[np.uint8]  # red, green, blue, shape (height, width, 3); row 0 is the highest
    fovy: float  # angle from the lowest to the highest row [rad]


def yaw_of(odometry: Odometry) -> float:
    """Return the robot's heading [rad], world frame."""
    return -turn_to(0.0, odometry.orientation_wxyz)


def point_at(odometry: Odometry, angle: float, distance: float) -> Vector:
    """Return the place [m], world frame, that the robot sees at an angle [rad] and distance [m]."""
    (x, y, z), heading = odometry.position, yaw_of(odometry) + angle
    return (x + distance * cos(heading), y + distance * sin(heading), z)


def place_of(odometry: Odometry, point: Vector) -> Vector:
    """Return the place [m], world frame, of a `point` in the robot's frame [m]: ahead, left, up."""
    (x, y, z), (a, b, c) = odometry.position, rotate(odometry.orientation_wxyz, point)
    return x + a, y + b, z + c


class Perception:
    """Turns scans or pictures into setpoints; a plug-in has to define `see` only.

    Attributes:
        takes: Sensor whose data `see` gets: "scan", a `Scan`, or "camera", a `Frame`.
    """

    takes: Literal["scan", "camera"] = "scan"

    def reset(self) -> None:
        """Forget everything at the start of a mission."""

    def see(self, seen: Any, odometry: Odometry) -> Setpoint | None:
        """Return where the robot has to go, world frame; None: the last setpoint stays.

        Cloud brings the position into the fence. It flies to the setpoint as if teleop had given
        it; epoch, waypoint and motion of the result do not count.

        Args:
            seen: The newest `Scan` or `Frame` that has arrived, as `takes` says.
            odometry: Pose and twist as measured when `seen` was taken, or just before.
        """
        raise NotImplementedError
